"""The rules of the paper's appendix A, applied to what a model said: every thing once, nobody's hand, one table."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from schemas.detection import Box, Composite, Container, Content, Detection, DetectionRemark, Detections
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.stages.perceive.vlm.boxes import area, likeness, share_inside, shared
from tableverse_factory.stages.perceive.vlm.label_lexicon import (
    may_name_table,
    may_share_name,
    names_person,
    names_table,
    names_table_exactly,
    names_whole_person,
)
from tableverse_factory.stages.perceive.vlm.non_solid_labels import fills, names_non_solid
from tableverse_factory.stages.perceive.vlm.parse_answer import ParsedAnswer, ParsedComposite, ParsedDetection

NO_TABLE = "no_table_detected"
MAX_BEHIND = 0.5
"""Share of its box within a person's beyond which a thing that is not held counts as behind the person."""
SAME_BOX = 0.85
"""Intersection over union from which two boxes with the same name are one thing."""
INSIDE = 0.8
"""Share of its box within another's from which something lies in it."""
GROUP_SHARE = 0.6
"""Share of the container's box from which the box of counted contents is that of all of them."""


@dataclass(frozen=True, slots=True)
class PostprocessedAnswer:
    """An answer that keeps the rules.

    Attributes:
        table: Whether a table is in it.
        remarks: What was left out or changed, in the order of the rules.
    """

    answer: Detections
    table: bool
    remarks: tuple[DetectionRemark, ...]


def apply_rules(said: ParsedAnswer) -> PostprocessedAnswer:
    """The answer with every rule kept.

    Raises:
        AnswerInvalidError: `no_table_detected` if things are listed but no table: asked again, a model may see it.
    """
    rules = _RuleSet(said)
    rules.drop_people()
    rules.choose_table()
    rules.drop_what_is_behind()
    rules.empty_containers()
    rules.drop_matter()
    rules.keep_once()
    rules.part_groups()
    return PostprocessedAnswer(rules.detections(), rules.table is not None, tuple(rules.remarks))


class _RuleSet:
    """The rules one by one; each leaves `things` and `filled` in the order of the answer."""

    def __init__(self, said: ParsedAnswer) -> None:
        self.things: list[ParsedDetection] = [*said.things]
        self.filled: list[ParsedComposite] = [*said.filled]
        self.table: ParsedDetection | None = None
        self.remarks: list[DetectionRemark] = [*said.remarks]
        reported = [thing.box for thing in said.things if names_whole_person(thing.label)]
        self._people: Sequence[Box] = reported if said.people is None else said.people

    def detections(self) -> Detections:
        """In the paper's schema: the table first, containers without contents among the single things."""
        empty = [item.container for item in self.filled if not item.contents]
        singles = [*self.things, *empty]
        table = [] if self.table is None else [_to_detection(replace(self.table, label="table"))]
        composites = [_to_composite(item) for item in self.filled if item.contents]
        return Detections(detections=(*table, *map(_to_detection, singles)), composites=tuple(composites))

    def drop_people(self) -> None:
        """No person and no part of one; what stood in such a `container` stands for itself."""
        self.things = [thing for thing in self.things if not self._is_person(thing)]
        kept = []
        for item in self.filled:
            contents = tuple(thing for thing in item.contents if not self._is_person(thing))
            if self._is_person(item.container):
                self.things += contents
            else:
                kept.append(replace(item, contents=contents))
        self.filled = kept

    def choose_table(self) -> None:
        """What is labelled as asked is the table, else the largest of what is named one; it contains nothing.

        A label that may name something else ("surface", "white counter") counts where no other names a table.
        """
        said = [*self.things, *(item.container for item in self.filled)]
        is_table = names_table if any(names_table(thing.label) for thing in said) else may_name_table
        for item in [item for item in self.filled if is_table(item.container.label)]:
            self._remark(item.container, "table_as_container", "what stands on a table is not in it")
            self.filled.remove(item)
            self.things += (item.container, *item.contents)
        tables = [thing for thing in self.things if is_table(thing.label)]
        if not tables and (self.things or self.filled):
            raise AnswerInvalidError(
                "no box is labelled 'table'. If the top of a table, desk or counter is visible, add it to `detections`"
                "; if there is none, give empty lists",
                NO_TABLE,
            )
        self.table = max(tables, key=lambda it: (names_table_exactly(it.label), area(it.box)), default=None)
        others = [it for it in tables if it is not self.table and names_table(it.label)]
        for thing in others:
            self._remark(thing, "second_table", "another box is the table's")
        self.things = [it for it in self.things if it is not self.table and all(it is not other for other in others)]

    def drop_what_is_behind(self) -> None:
        """Nothing that is not held and lies mostly in a person's box; the table neither.

        What is listed in a container that goes is looked at by itself: it may be held, or be in front.
        """
        self.things = [thing for thing in self.things if not self._is_behind(thing)]
        kept = []
        for item in self.filled:
            if self._is_behind(item.container):
                self.things += [thing for thing in item.contents if not self._is_behind(thing)]
            else:
                kept.append(item)
        self.filled = kept
        if self.table is not None and self._is_behind(self.table):
            self.table = None

    def empty_containers(self) -> None:
        """A container with anything in it that is not solid is one thing; what lies apart from it is no content."""
        for k, item in enumerate(self.filled):
            holder = item.container
            matter = next((it for it in item.contents if fills(it.label, holder.label, is_listed_in_it=True)), None)
            apart = [thing for thing in item.contents if shared(thing.box, holder.box) <= 0]
            if matter is not None:
                self._remark(holder, "not_solid", f"one thing with {matter.label!r} in it")
                for thing in item.contents:
                    self._remark(thing, "not_solid", f"one thing with {holder.label!r}")
                self.filled[k] = replace(item, contents=())
            elif apart:
                for thing in apart:
                    self._remark(thing, "not_inside", f"apart from {holder.label!r}")
                self.things += apart
                self.filled[k] = replace(item, contents=tuple(t for t in item.contents if t not in apart))
            elif not item.contents:
                self._remark(holder, "empty_container", "one thing, for nothing is listed in it")

    def drop_matter(self) -> None:
        """What is no solid thing and lies in the box of what holds such is its filling; else it names its container."""
        others = [*self.things, *(thing for item in self.filled for thing in (item.container, *item.contents))]
        kept = []
        for thing in self.things:
            if (holder := _find_container(thing, others)) is not None:
                self._remark(thing, "not_solid", f"what fills {holder.label!r}")
            else:
                kept.append(thing)
        self.things = kept

    def keep_once(self) -> None:
        """Every thing once: as a container, else as a content, else as a single thing."""
        self._merge_containers()
        holders = [item.container for item in self.filled]
        inside: list[ParsedDetection] = []
        for k, item in enumerate(self.filled):
            contents: list[ParsedDetection] = []
            for thing in item.contents:
                if self._is_new(thing, [*holders, *inside, *contents]):
                    contents.append(thing)
            self.filled[k] = replace(item, contents=tuple(contents))
            inside += contents
        singles: list[ParsedDetection] = []
        for thing in self.things:
            if self._is_new(thing, [*holders, *inside, *singles]) and not self._is_counted(thing):
                singles.append(thing)
        self.things = singles

    def part_groups(self) -> None:
        """A box around all of several contents is one thing: copies of it would be as many heaps."""
        for k, item in enumerate(self.filled):
            contents = tuple(self._split_group(thing, item.container) for thing in item.contents)
            self.filled[k] = replace(item, contents=contents)

    def _is_person(self, thing: ParsedDetection) -> bool:
        return names_person(thing.label) and self._remark(thing, "person", "a person, or a part of one")

    def _is_behind(self, thing: ParsedDetection) -> bool:
        share = max((share_inside(thing.box, person) for person in self._people), default=0.0)
        if thing.held or share <= MAX_BEHIND:
            return False
        return self._remark(thing, "behind_person", f"{share:.0%} of its box lies in a person's, and it is not held")

    def _merge_containers(self) -> None:
        """Composites of one and the same container become one."""
        joined: list[ParsedComposite] = []
        for item in self.filled:
            k = next((k for k, other in enumerate(joined) if _is_same(item.container, other.container)), None)
            if k is None:
                joined.append(item)
                continue
            self._remark(item.container, "duplicate", f"the same as {joined[k].container.where}")
            joined[k] = replace(joined[k], contents=(*joined[k].contents, *item.contents))
        self.filled = joined

    def _is_new(self, thing: ParsedDetection, others: Sequence[ParsedDetection]) -> bool:
        twin = next((other for other in others if _is_same(thing, other)), None)
        return twin is None or not self._remark(thing, "duplicate", f"the same as {twin.where}")

    def _is_counted(self, thing: ParsedDetection) -> bool:
        """Whether the thing is one of those that the `count` of some contents stands for."""
        for item in self.filled:
            for content in item.contents:
                if content.count > 1 and _is_named_inside(thing, content, item.container):
                    return self._remark(thing, "counted", f"one of the {content.count} of {content.where}")
        return False

    def _split_group(self, thing: ParsedDetection, container: ParsedDetection) -> ParsedDetection:
        share = area(thing.box) / area(container.box)
        if thing.count == 1 or share < GROUP_SHARE:
            return thing
        self._remark(thing, "group", f"its box is {share:.0%} of its container's: taken for one, not {thing.count}")
        return replace(thing, count=1)

    def _remark(self, thing: ParsedDetection, rule: str, detail: str) -> bool:
        """Keeps a remark; true, so that a rule can say it and act on it at once."""
        self.remarks.append(DetectionRemark(where=thing.where, label=thing.label, rule=rule, detail=detail[:500]))
        return True


def _is_same(a: ParsedDetection, b: ParsedDetection) -> bool:
    return likeness(a.box, b.box) >= SAME_BOX and may_share_name(a.label, b.label)


def _is_named_inside(thing: ParsedDetection, content: ParsedDetection, container: ParsedDetection) -> bool:
    return share_inside(thing.box, container.box) >= INSIDE and may_share_name(thing.label, content.label)


def _find_container(matter: ParsedDetection, others: Sequence[ParsedDetection]) -> ParsedDetection | None:
    """What the thing fills, by its name and box."""
    return next((other for other in others if _is_filled_with(other, matter)), None)


def _is_filled_with(holder: ParsedDetection, matter: ParsedDetection) -> bool:
    if holder is matter or not fills(matter.label, holder.label, is_listed_in_it=False):
        return False
    return not names_non_solid(holder.label) and share_inside(matter.box, holder.box) >= INSIDE


def _to_detection(thing: ParsedDetection) -> Detection:
    return Detection(label=thing.label, bbox_xyxy=thing.box, score=thing.score, description=thing.description)


def _to_composite(item: ParsedComposite) -> Composite:
    holder = Container(label=item.container.label, bbox=item.container.box, description=item.container.description)
    contents = tuple(
        Content(label=thing.label, bbox=thing.box, count=thing.count, description=thing.description)
        for thing in item.contents
    )
    return Composite(description=item.description, container=holder, contents=contents)
