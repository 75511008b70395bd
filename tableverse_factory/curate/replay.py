"""The judge `replay`: answers recorded earlier, one file per scene, read as leniently as is safe."""

import json
import re
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from schemas.config import CurateConfig
from schemas.curation import (
    GeneratedTask,
    JudgeAnswer,
    PhysicalProperties,
    Relabelling,
    SevereLabelError,
)
from tableverse_factory.curate.case import Case
from tableverse_factory.curate.invalid import AnswerInvalid

MAX_ANSWER_BYTES = 1_000_000
MAX_TASKS = 500
MAX_ENTRIES = 1000
UNREADABLE_ID = -1
"""Stands where an answer gives something that is no integer for an id; it is never a valid one."""

_FENCE = re.compile(r"```[A-Za-z0-9_-]*\s*\n?(.*?)```", re.DOTALL)


class ReplayJudge:
    """Reads `<replay_dir>/<scene_id>.json`."""

    def __init__(self, config: CurateConfig) -> None:
        self._folder = Path(config.replay_dir)

    def answer(self, case: Case) -> JudgeAnswer:
        """The recorded answer.

        Raises:
            AnswerInvalid: if there is none, it is too large, or it is no answer in the paper's schema.
        """
        path = self._folder / f"{case.scene_id}.json"
        try:
            with path.open("rb") as file:
                data = file.read(MAX_ANSWER_BYTES + 1)
        except OSError as error:
            raise AnswerInvalid(f"no recorded answer: {error.strerror}", "judge_answer_missing") from error
        return parse_answer(data.decode("utf-8", errors="replace"))


def parse_answer(text: str) -> JudgeAnswer:
    """A model's text as an answer: fences and prose around the object are cut off, bad entries are left out.

    Usability, criteria and score must be there and sound: without them there is no verdict. Entries of the other
    parts that do not validate are left out one by one; tasks lose only what cannot be read in them, so that the
    checks can refuse each with its reason.

    Raises:
        AnswerInvalid: if it is too large, no JSON object, or lacks those three.
    """
    if len(text) > MAX_ANSWER_BYTES:
        raise AnswerInvalid(f"the answer is longer than {MAX_ANSWER_BYTES} characters")
    raw = _object_in(text)
    cleaned = {
        "usability": raw.get("usability"),
        "per_criterion": raw.get("per_criterion"),
        "final_score": raw.get("final_score"),
        "severe_label_error": _one_or(raw.get("severe_label_error"), SevereLabelError, {}),
        "label_confidence": _confidences(raw.get("label_confidence")),
        "physical_properties": _sound_entries(raw.get("physical_properties"), PhysicalProperties),
        "object_relabeling": _sound_entries(raw.get("object_relabeling"), Relabelling),
        "generated_tasks": _readable_tasks(raw.get("generated_tasks")),
    }
    try:
        return JudgeAnswer.model_validate(cleaned)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part)[:100] for part in first["loc"][:6])
        raise AnswerInvalid(f"{where}: {first['msg']}"[:500]) from error


def _object_in(text: str) -> dict[str, Any]:
    fenced = _FENCE.search(text)
    body = fenced.group(1) if fenced else text
    start, end = body.find("{"), body.rfind("}")
    if start < 0 or end < start:
        raise AnswerInvalid("the answer holds no JSON object")
    try:
        value = json.loads(body[start : end + 1])
    except (ValueError, RecursionError) as error:
        raise AnswerInvalid(f"the answer is no JSON: {error}"[:300]) from error
    if not isinstance(value, dict):
        raise AnswerInvalid("the answer is no JSON object")
    return value


def _is_sound(value: Any, kind: type[BaseModel]) -> bool:
    try:
        kind.model_validate(value)
    except ValidationError:
        return False
    return True


def _one_or(value: Any, kind: type[BaseModel], otherwise: Any) -> Any:
    return value if _is_sound(value, kind) else otherwise


def _sound_entries(value: Any, kind: type[BaseModel]) -> dict[str, Any]:
    entries = list(value.items())[:MAX_ENTRIES] if isinstance(value, dict) else []
    return {key: entry for key, entry in entries if _is_sound(entry, kind)}


def _confidences(value: Any) -> dict[str, float]:
    entries = list(value.items())[:MAX_ENTRIES] if isinstance(value, dict) else []
    return {
        key: float(entry)
        for key, entry in entries
        if isinstance(entry, int | float) and not isinstance(entry, bool) and 0.0 <= entry <= 1.0
    }


def _readable_tasks(value: Any) -> list[dict[str, Any]]:
    tasks = value[:MAX_TASKS] if isinstance(value, list) else []
    return [_readable_task(task if isinstance(task, dict) else {}) for task in tasks]


def _readable_task(task: dict[str, Any]) -> dict[str, Any]:
    readable: dict[str, Any] = {key: _text(task.get(key)) for key in ("instruction", "X_name", "Y_name", "relation")}
    readable["relation"] = readable["relation"][:100]
    readable["instruction"] = readable["instruction"][:1000]
    for key in ("X_id", "Y_id"):
        readable[key] = _integer(task.get(key))
    readable["initial_relation_satisfied"] = task.get("initial_relation_satisfied") is True
    if not _is_sound(readable, GeneratedTask):
        readable = {**readable, "X_name": "", "Y_name": ""}
    return readable


def _text(value: Any) -> str:
    return value[:4000] if isinstance(value, str) else ""


def _integer(value: Any) -> int:
    if isinstance(value, str) and re.fullmatch(r"-?\d{1,9}", value.strip()):
        return int(value)
    is_integer = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 10**9
    return value if is_integer else UNREADABLE_ID
