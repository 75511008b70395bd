"""A model's words as an answer: read as leniently as is safe."""

import re
from typing import Any

from pydantic import BaseModel, ValidationError

from schemas.curation import GeneratedTask, JudgeAnswer, PhysicalProperties, Relabelling, SevereLabelError
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.models.remote.exchange import whole_text
from tableverse_factory.models.remote.json_text import json_object

MAX_TASKS = 500
MAX_ENTRIES = 1000
UNREADABLE_ID = -1
"""Stands where an answer gives something that is no integer for an id; it is never a valid one."""

_ID = re.compile(r"-?[0-9]{1,9}")


def parse_judgement(text: str) -> JudgeAnswer:
    """A model's text as an answer: fences and prose around the object are cut off, bad entries are left out.

    Usability, criteria and score must be there and sound: without them there is no verdict. Entries of the other
    parts that do not validate are left out one by one; tasks lose only what cannot be read in them, so that the
    checks can refuse each with its reason.

    Raises:
        AnswerInvalidError: if it is too large, no JSON object, or lacks those three.
    """
    raw = json_object(text)
    cleaned = {
        "usability": raw.get("usability"),
        "per_criterion": raw.get("per_criterion"),
        "final_score": raw.get("final_score"),
        "severe_label_error": _read_label_errors(raw.get("severe_label_error")),
        "label_confidence": _read_confidences(raw.get("label_confidence")),
        "physical_properties": _keep_valid_entries(raw.get("physical_properties"), PhysicalProperties),
        "object_relabeling": _keep_valid_entries(raw.get("object_relabeling"), Relabelling),
        "generated_tasks": _read_tasks(raw.get("generated_tasks")),
    }
    try:
        return JudgeAnswer.model_validate(cleaned)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part)[:100] for part in first["loc"][:6])
        raise AnswerInvalidError(f"{where}: {first['msg']}"[:500]) from error


def _is_valid(value: Any, kind: type[BaseModel]) -> bool:
    try:
        kind.model_validate(value)
    except ValidationError:
        return False
    return True


def _list_entries(value: Any) -> list[tuple[str, Any]]:
    """What a mapping says of ids."""
    pairs = list(value.items())[:MAX_ENTRIES] if isinstance(value, dict) else []
    return [(key, entry) for key, entry in pairs if _ID.fullmatch(key)]


def _keep_valid_entries(value: Any, kind: type[BaseModel]) -> dict[str, Any]:
    return {key: entry for key, entry in _list_entries(value) if _is_valid(entry, kind)}


def _read_label_errors(value: Any) -> Any:
    """Part B; strict servers make a model name every id, with null for those without an error."""
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


def _read_tasks(value: Any) -> list[dict[str, Any]]:
    tasks = value[:MAX_TASKS] if isinstance(value, list) else []
    return [_read_task(task if isinstance(task, dict) else {}) for task in tasks]


def _read_task(task: dict[str, Any]) -> dict[str, Any]:
    readable: dict[str, Any] = {
        key: _read_text(task.get(key)) for key in ("instruction", "X_name", "Y_name", "relation")
    }
    readable["relation"] = readable["relation"][:100]
    readable["instruction"] = readable["instruction"][:1000]
    for key in ("X_id", "Y_id"):
        readable[key] = _read_integer(task.get(key))
    readable["initial_relation_satisfied"] = task.get("initial_relation_satisfied") is True
    if not _is_valid(readable, GeneratedTask):
        readable = {**readable, "X_name": "", "Y_name": ""}
    return readable


def _read_text(value: Any) -> str:
    return whole_text(value[:4000]) if isinstance(value, str) else ""


def _read_integer(value: Any) -> int:
    if isinstance(value, str) and re.fullmatch(r"-?\d{1,9}", value.strip()):
        return int(value)
    is_integer = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 10**9
    return value if is_integer else UNREADABLE_ID
