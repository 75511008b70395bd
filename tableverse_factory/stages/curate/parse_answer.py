"""Lenient parser of a judge's answer: whatever is unreadable is left out before the rest is validated."""

import re
from itertools import islice
from typing import Any

from pydantic import BaseModel, ValidationError

from schemas.curation import GeneratedTask, JudgeAnswer, PhysicalProperties, Relabelling, SevereLabelError
from tableverse_factory.models.remote.exchange import replace_lone_surrogates
from tableverse_factory.models.remote.json_text import parse_json_object, validate_answer

MAX_TASKS = 500
MAX_ENTRIES = 1000
UNREADABLE_ID = -1  # replaces an id that is no integer; never valid
_ID = re.compile(r"-?[0-9]{1,9}")


def parse_judgement(text: str) -> JudgeAnswer:
    """Parse a model's text; fences and prose around the JSON object are ignored.

    Usability, criteria and score are required: without them there is no verdict. Entries of the other parts that do
    not validate are left out one by one; tasks lose only their unreadable fields, so that the checks can refuse each
    with its reason.

    Raises:
        AnswerInvalidError: if the text is too long, holds no JSON object, or lacks those three.
    """
    raw = parse_json_object(text)
    tasks = raw.get("generated_tasks")
    cleaned = {
        **{name: raw.get(name) for name in ("usability", "per_criterion", "final_score")},
        "severe_label_error": _read_label_errors(raw.get("severe_label_error")),
        "label_confidence": _read_confidences(raw.get("label_confidence")),
        "physical_properties": _keep_valid_entries(raw.get("physical_properties"), PhysicalProperties),
        "object_relabeling": _keep_valid_entries(raw.get("object_relabeling"), Relabelling),
        "generated_tasks": [_read_task(task) for task in (tasks[:MAX_TASKS] if isinstance(tasks, list) else [])],
    }
    return validate_answer(cleaned, JudgeAnswer)


def _is_valid(value: Any, kind: type[BaseModel]) -> bool:
    try:
        kind.model_validate(value)
    except ValidationError:
        return False
    return True


def _list_entries(value: Any) -> list[tuple[str, Any]]:
    pairs = islice(value.items(), MAX_ENTRIES) if isinstance(value, dict) else ()
    return [(key, entry) for key, entry in pairs if _ID.fullmatch(key)]


def _keep_valid_entries(value: Any, kind: type[BaseModel]) -> dict[str, Any]:
    return {key: entry for key, entry in _list_entries(value) if _is_valid(entry, kind)}


def _read_label_errors(value: Any) -> Any:
    """Read part B; strict servers make a model name every id, with null for those without an error."""
    if not isinstance(value, dict):
        return {}
    labels = {key: entry for key, entry in _list_entries(value.get("correct_labels")) if isinstance(entry, str)}
    errors = {**value, "correct_labels": labels}
    return errors if _is_valid(errors, SevereLabelError) else {}


def _read_confidences(value: Any) -> dict[str, float]:
    return {
        key: float(entry)
        for key, entry in _list_entries(value)
        if isinstance(entry, int | float) and not isinstance(entry, bool) and 0.0 <= entry <= 1.0
    }


def _read_task(value: Any) -> dict[str, Any]:
    task = value if isinstance(value, dict) else {}
    readable: dict[str, Any] = {
        "instruction": _read_text(task.get("instruction"))[:1000],
        "X_id": _read_integer(task.get("X_id")),
        "X_name": _read_text(task.get("X_name")),
        "Y_id": _read_integer(task.get("Y_id")),
        "Y_name": _read_text(task.get("Y_name")),
        "relation": _read_text(task.get("relation"))[:100],
        "initial_relation_satisfied": task.get("initial_relation_satisfied") is True,
    }
    return readable if _is_valid(readable, GeneratedTask) else readable | {"X_name": "", "Y_name": ""}


def _read_text(value: Any) -> str:
    return replace_lone_surrogates(value[:4000]) if isinstance(value, str) else ""


def _read_integer(value: Any) -> int:
    if isinstance(value, str) and re.fullmatch(r"-?\d{1,9}", value.strip()):
        return int(value)
    is_integer = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 10**9
    return value if is_integer else UNREADABLE_ID
