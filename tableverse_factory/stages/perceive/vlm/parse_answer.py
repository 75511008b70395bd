"""A detector's words as boxes with labels: read as leniently as is safe, before any rule is applied."""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from schemas.detection import MAX_COUNT, MAX_DETECTIONS, Box, DetectionRemark
from schemas.identity import clean_label
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.models.remote.exchange import whole_text
from tableverse_factory.models.remote.json_text import MAX_ANSWER_CHARS, json_object
from tableverse_factory.stages.perceive.vlm.boxes import (
    BoxScale,
    Corners,
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
    """One entry of an answer.

    Attributes:
        where: Its place in the answer, such as `composites[0].contents[1]`.
        label: Cleaned; still untrusted.
        box: Within the picture.
        held: Whether somebody holds it.
        count: How many of it there are.
    """

    where: str
    label: str
    box: Box
    score: float = 1.0
    description: str = ""
    held: bool = False
    count: int = 1


@dataclass(frozen=True, slots=True)
class ParsedComposite:
    """A composite of an answer; its contents may be none."""

    container: ParsedDetection
    contents: tuple[ParsedDetection, ...]
    description: str = ""


@dataclass(frozen=True, slots=True)
class ParsedAnswer:
    """What an answer says.

    Attributes:
        people: Boxes of persons seen with head and torso; None where the answer has no such list.
        remarks: What could not be read, or only after it was put right.
    """

    things: tuple[ParsedDetection, ...]
    filled: tuple[ParsedComposite, ...]
    people: tuple[Box, ...] | None
    remarks: tuple[DetectionRemark, ...]


def parse_detections(text: str, order: BoxOrder, sent: ImageSize) -> ParsedAnswer:
    """A model's text as what it says; entries that cannot be read are left out one by one, with a remark.

    Args:
        text: The model's words.
        order: In which it was asked to give the numbers of a box.
        sent: Width and height of the picture that it saw [px].

    Raises:
        AnswerInvalidError: if there is no JSON object, none of the two lists, too many entries, boxes in no unit that
            can be told, or most entries cannot be read.
    """
    answer = _extract_object(text)
    detections, composites = _read_list(answer, "detections"), _read_list(answer, "composites")
    if "detections" not in answer and "composites" not in answer:
        raise AnswerInvalidError("the answer has neither `detections` nor `composites`")
    people = _read_list(answer, "people")[:MAX_PEOPLE] if "people" in answer else None
    entries = [*_list_entries(detections, composites)]
    if len(entries) > MAX_DETECTIONS:
        raise AnswerInvalidError(f"the answer lists {len(entries)} things; a table has at most {MAX_DETECTIONS}")
    reader = _EntryReader(order, sent, infer_scale([*_read_boxes(entries, people or [], order)], sent))
    found = {where: thing for where, entry in entries if (thing := reader.thing(where, entry)) is not None}
    if len(found) < len(entries) / 2:
        worst = [remark for remark in reader.remarks if remark.rule == "unreadable"][-1]
        raise AnswerInvalidError(f"most entries cannot be used; {worst.where}: {worst.detail}")
    singles = tuple(found[where] for k in range(len(detections)) if (where := f"detections[{k}]") in found)
    filled, loose = _read_composites(composites, found, reader.remarks)
    seen = None if people is None else tuple(box for entry in people if (box := reader.box(entry)[0]) is not None)
    return ParsedAnswer((*singles, *loose), filled, seen, tuple(reader.remarks))


def _extract_object(text: str) -> dict[str, Any]:
    """The object, also where boxes stand in it as bare tags, which are no JSON; a bare list is one of detections."""
    if (listed := _extract_list(text)) is not None:
        return listed[0] if len(listed) == 1 and _is_answer(listed[0]) else {"detections": listed}
    try:
        return json_object(text)
    except AnswerInvalidError:
        if "<bbox>" not in text:
            raise
        return json_object(_TAG.sub(_convert_tag, text))


def _is_answer(value: Any) -> bool:
    return isinstance(value, dict) and isinstance(value.get("detections", value.get("composites")), list)


def _extract_list(text: str) -> list[Any] | None:
    """The list that Gemini's models like to give instead of an object; None where there is no such."""
    start, end = text.find("["), text.rfind("]")
    if not 0 <= start < end or 0 <= text.find("{") < start or len(text) > MAX_ANSWER_CHARS:
        return None
    try:
        value = json.loads(text[start : end + 1])
    except (ValueError, RecursionError):  # no list: the object, if there is one, stands elsewhere
        return None
    return value if isinstance(value, list) else None


def _convert_tag(tag: re.Match[str]) -> str:
    return f"[{', '.join(tag[2].replace(',', ' ').split())}]"


def _read_list(answer: Mapping[str, Any], name: str) -> list[Any]:
    value = answer.get(name)
    if value is not None and not isinstance(value, list):
        raise AnswerInvalidError(f"`{name}` is no list")
    return value or []


def _list_entries(detections: list[Any], composites: list[Any]) -> Iterator[tuple[str, Any]]:
    """Every entry that should have a label and a box, by its place in the answer."""
    yield from ((f"detections[{k}]", entry) for k, entry in enumerate(detections))
    for k, composite in enumerate(composites):
        parts = composite if isinstance(composite, Mapping) else {}
        contents = parts.get("contents")
        yield f"composites[{k}].container", parts.get("container")
        inside = contents if isinstance(contents, list) else [contents] if contents is not None else []
        yield from ((f"composites[{k}].contents[{n}]", entry) for n, entry in enumerate(inside))


def _read_boxes(entries: list[tuple[str, Any]], people: list[Any], order: BoxOrder) -> Iterator[Corners]:
    for entry in (*(entry for _, entry in entries), *people):
        corners = read_corners(entry, order)
        if corners is not None:
            yield corners


def _read_composites(
    composites: list[Any], found: Mapping[str, ParsedDetection], remarks: list[DetectionRemark]
) -> tuple[tuple[ParsedComposite, ...], tuple[ParsedDetection, ...]]:
    """The composites, and the contents of those whose container cannot be read, as things of their own."""
    whole: list[ParsedComposite] = []
    loose: list[ParsedDetection] = []
    for k, composite in enumerate(composites):
        contents = tuple(thing for where, thing in found.items() if where.startswith(f"composites[{k}].contents["))
        container = found.get(f"composites[{k}].container")
        if container is not None:
            whole.append(ParsedComposite(container, contents, _read_text(composite.get("description"))))
            continue
        loose += contents
        remarks += [
            DetectionRemark(where=thing.where, label=thing.label, rule="without_container") for thing in contents
        ]
    return tuple(whole), tuple(loose)


class _EntryReader:
    """Reads entries in one order and unit, and keeps what there is to remark."""

    def __init__(self, order: BoxOrder, sent: ImageSize, scale: BoxScale) -> None:
        self._order, self._sent, self._scale = order, sent, scale
        self.remarks: list[DetectionRemark] = []
        if scale.unit != "thousandths":
            self.remarks.append(DetectionRemark(where="", rule="unit", detail=f"boxes are given in {scale.unit}"))

    def thing(self, where: str, entry: Any) -> ParsedDetection | None:
        """An entry as a thing; None where it has no label or no box that is of use."""
        label = entry.get("label") if isinstance(entry, Mapping) else None
        if not isinstance(label, str) or not label.strip():
            return self._reject(where, "", "it has no label")
        name = clean_label(whole_text(label[:4000]))
        box, done = self.box(entry)
        if box is None:
            return self._reject(where, name, done)
        if done:
            self.remarks.append(DetectionRemark(where=where, label=name, rule="box", detail=done))
        score, count = self._score(where, name, entry.get("score")), self._count(where, name, entry.get("count"))
        if count == 0:
            return self._reject(where, name, "there are none of it")
        return ParsedDetection(
            where, name, box, score, _read_text(entry.get("description")), entry.get("held") is True, count
        )

    def box(self, entry: Any) -> tuple[Box | None, str]:
        """The box of an entry, and what was done for it or is wrong with it."""
        corners = read_corners(entry, self._order)
        return (
            (None, "it has no box of four numbers")
            if corners is None
            else normalise_box(corners, self._scale, self._sent)
        )

    def _reject(self, where: str, label: str, why: str) -> ParsedDetection | None:
        self.remarks.append(DetectionRemark(where=where, label=label, rule="unreadable", detail=why))
        return None

    def _score(self, where: str, label: str, value: Any) -> float:
        score = 1.0 if value is None else read_number(value)
        if 0.0 <= score <= 1.0:
            return score
        self.remarks.append(
            DetectionRemark(where=where, label=label, rule="score", detail="it is no number from 0 to 1")
        )
        return 1.0

    def _count(self, where: str, label: str, value: Any) -> int:
        """How many there are, 0 to `MAX_COUNT`; 1 where it is not said."""
        said = 1.0 if value is None else read_number(value)
        if 0 <= said <= MAX_COUNT and said == int(said):
            return int(said)
        count = MAX_COUNT if said > MAX_COUNT else 1
        self.remarks.append(DetectionRemark(where=where, label=label, rule="count", detail=f"taken for {count}"))
        return count


def _read_text(value: Any) -> str:
    """A description on one line."""
    if not isinstance(value, str):
        return ""
    shown = "".join(c if c.isprintable() else " " for c in whole_text(value[: 4 * MAX_DESCRIPTION_CHARS]))
    return " ".join(shown.split())[:MAX_DESCRIPTION_CHARS]
