"""Lenient parser of a detector's answer into labelled boxes, before any rule is applied."""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from schemas.detection import MAX_COUNT, MAX_DETECTIONS, Box, DetectionRemark
from schemas.identity import clean_label
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.models.remote.exchange import replace_lone_surrogates
from tableverse_factory.models.remote.json_text import MAX_ANSWER_CHARS, parse_json_object
from tableverse_factory.stages.perceive.vlm.boxes import (
    ImageSize,
    infer_scale,
    normalise_box,
    read_corners,
    read_number,
)
from tableverse_factory.stages.perceive.vlm.prompt import BoxOrder

MAX_DESCRIPTION_CHARS = 500
MAX_PEOPLE = 50

_TAG = re.compile(r'(")?<bbox>([-+\d.eE, ]{7,100})</bbox>(?(1)")')


@dataclass(frozen=True, slots=True)
class ParsedDetection:
    """One entry of an answer."""

    where: str  # its place there, such as `composites[0].contents[1]`
    label: str  # cleaned, but still untrusted
    box: Box  # within the picture, in thousandths
    score: float = 1.0
    description: str = ""
    held: bool = False  # in a person's hand
    count: int = 1


@dataclass(frozen=True, slots=True)
class ParsedComposite:
    """A container with its contents, of which there may be none."""

    container: ParsedDetection
    contents: tuple[ParsedDetection, ...]
    description: str = ""


@dataclass(frozen=True, slots=True)
class ParsedAnswer:
    """A parsed answer, with remarks on entries that were unreadable or had to be corrected."""

    detections: tuple[ParsedDetection, ...]
    composites: tuple[ParsedComposite, ...]
    people: tuple[Box, ...] | None  # persons seen with head and torso; None where there is no such list
    remarks: tuple[DetectionRemark, ...]


def parse_detections(text: str, order: BoxOrder, sent: ImageSize) -> ParsedAnswer:
    """Parse a model's text; unreadable entries are left out one by one, with a remark.

    Raises:
        AnswerInvalidError: if there is no JSON object or none of the two lists, the unit of the boxes is unclear,
            there are too many entries, or most are unreadable.
    """
    answer = _extract_object(text)
    detections, composites = _read_list(answer, "detections"), _read_list(answer, "composites")
    if "detections" not in answer and "composites" not in answer:
        raise AnswerInvalidError("the answer has neither `detections` nor `composites`")
    people = _read_list(answer, "people")[:MAX_PEOPLE] if "people" in answer else None
    entries = dict(_list_entries(detections, composites))
    if len(entries) > MAX_DETECTIONS:
        raise AnswerInvalidError(f"the answer lists {len(entries)} things; a table has at most {MAX_DETECTIONS}")
    reader = _EntryReader([*entries.values(), *(people or [])], order, sent)
    found = {where: item for where, entry in entries.items() if (item := reader.read_detection(where, entry))}
    if len(found) < len(entries) / 2:
        worst = [remark for remark in reader.remarks if remark.rule == "unreadable"][-1]
        raise AnswerInvalidError(f"most entries cannot be used; {worst.where}: {worst.detail}")
    singles = [found[where] for k in range(len(detections)) if (where := f"detections[{k}]") in found]
    whole: list[ParsedComposite] = []
    for k, composite in enumerate(composites):
        contents = tuple(item for where, item in found.items() if where.startswith(f"composites[{k}].contents["))
        if container := found.get(f"composites[{k}].container"):
            whole.append(ParsedComposite(container, contents, _read_text(composite.get("description"))))
        else:
            singles += contents
            for item in contents:
                reader.remark(item.where, item.label, "without_container")
    boxes = None if people is None else tuple(box for entry in people if (box := reader.read_box(entry)[0]) is not None)
    return ParsedAnswer(tuple(singles), tuple(whole), boxes, tuple(reader.remarks))


def _extract_object(text: str) -> dict[str, Any]:
    """Extract the object, also with boxes as bare tags, which are no JSON; a bare list is one of detections."""
    if (items := _extract_list(text)) is not None:
        return items[0] if len(items) == 1 and _is_answer(items[0]) else {"detections": items}
    try:
        return parse_json_object(text)
    except AnswerInvalidError:
        if "<bbox>" not in text:
            raise
        return parse_json_object(_TAG.sub(lambda tag: f"[{', '.join(tag[2].replace(',', ' ').split())}]", text))


def _is_answer(value: Any) -> bool:
    return isinstance(value, dict) and isinstance(value.get("detections", value.get("composites")), list)


def _extract_list(text: str) -> list[Any] | None:
    """Extract the list that Gemini's models tend to give instead of an object; None where there is none."""
    start, end = text.find("["), text.rfind("]")
    if not 0 <= start < end or 0 <= text.find("{") < start or len(text) > MAX_ANSWER_CHARS:
        return None
    try:
        value = json.loads(text[start : end + 1])
    except (ValueError, RecursionError):  # no list: the object, if there is one, stands elsewhere
        return None
    return value if isinstance(value, list) else None


def _read_list(answer: Mapping[str, Any], name: str) -> list[Any]:
    value = answer.get(name)
    if value is not None and not isinstance(value, list):
        raise AnswerInvalidError(f"`{name}` is no list")
    return value or []


def _list_entries(detections: list[Any], composites: list[Any]) -> Iterator[tuple[str, Any]]:
    """List every entry that should have a label and a box, with its place in the answer."""
    yield from ((f"detections[{k}]", entry) for k, entry in enumerate(detections))
    for k, composite in enumerate(composites):
        parts = composite if isinstance(composite, Mapping) else {}
        contents = parts.get("contents")
        yield f"composites[{k}].container", parts.get("container")
        inside = contents if isinstance(contents, list) else [contents] if contents is not None else []
        yield from ((f"composites[{k}].contents[{n}]", entry) for n, entry in enumerate(inside))


class _EntryReader:
    """Reads entries in one order and unit, and collects remarks."""

    def __init__(self, entries: list[Any], order: BoxOrder, sent: ImageSize) -> None:
        self._order, self._sent = order, sent
        corners = (read_corners(entry, order) for entry in entries)
        self._scale = infer_scale([box for box in corners if box is not None], sent)
        self.remarks: list[DetectionRemark] = []
        if self._scale.unit != "thousandths":
            self.remark("", "", "unit", f"boxes are given in {self._scale.unit}")

    def remark(self, where: str, label: str, rule: str, detail: str = "") -> None:
        self.remarks.append(DetectionRemark(where=where, label=label, rule=rule, detail=detail))

    def read_detection(self, where: str, entry: Any) -> ParsedDetection | None:
        """Read an entry; None where it has no label or no usable box."""
        label = entry.get("label") if isinstance(entry, Mapping) else None
        if not isinstance(label, str) or not label.strip():
            self.remark(where, "", "unreadable", "it has no label")
            return None
        name = clean_label(replace_lone_surrogates(label[:4000]))
        box, detail = self.read_box(entry)
        if box is None:
            self.remark(where, name, "unreadable", detail)
            return None
        if detail:
            self.remark(where, name, "box", detail)
        score, count = self._read_score(where, name, entry), self._read_count(where, name, entry)
        if count == 0:
            self.remark(where, name, "unreadable", "there are none of it")
            return None
        description, held = _read_text(entry.get("description")), entry.get("held") is True
        return ParsedDetection(where, name, box, score, description, held, count)

    def read_box(self, entry: Any) -> tuple[Box | None, str]:
        """Read the box of an entry, with what was corrected or is wrong."""
        corners = read_corners(entry, self._order)
        if corners is None:
            return None, "it has no box of four numbers"
        return normalise_box(corners, self._scale, self._sent)

    def _read_score(self, where: str, label: str, entry: Mapping[str, Any]) -> float:
        score = 1.0 if entry.get("score") is None else read_number(entry["score"])
        if 0.0 <= score <= 1.0:
            return score
        self.remark(where, label, "score", "it is no number from 0 to 1")
        return 1.0

    def _read_count(self, where: str, label: str, entry: Mapping[str, Any]) -> int:
        number = 1.0 if entry.get("count") is None else read_number(entry["count"])
        if 0 <= number <= MAX_COUNT and number == int(number):
            return int(number)
        count = MAX_COUNT if number > MAX_COUNT else 1
        self.remark(where, label, "count", f"taken for {count}")
        return count


def _read_text(value: Any) -> str:
    if not isinstance(value, str):
        return ""
    text = replace_lone_surrogates(value[: 4 * MAX_DESCRIPTION_CHARS])
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())[:MAX_DESCRIPTION_CHARS]
