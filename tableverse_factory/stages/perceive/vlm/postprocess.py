"""Rules of the paper's appendix A, applied to a parsed answer: every object once, no people, one table."""

from collections.abc import Sequence
from dataclasses import replace

from schemas.detection import Box, Composite, Container, Content, Detection, DetectionRemark, Detections
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.stages.perceive.base.box_overlap import (
    compute_area,
    compute_iou,
    compute_share_inside,
    intersect_boxes,
)
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
MAX_BEHIND = 0.5  # share of its box in a person's beyond which an object that is not held is behind the person
SAME_BOX = 0.85  # intersection over union from which two boxes with the same name are one object
INSIDE = 0.8  # share of its box within another's from which an object lies in it
GROUP_SHARE = 0.6  # share of the container's box from which the box of counted contents is that of all of them

AnswerByRules = tuple[Detections, tuple[DetectionRemark, ...]]  # and remarks on what was left out or changed


def apply_rules(parsed: ParsedAnswer) -> AnswerByRules:
    """Apply every rule; `no_table_detected` where objects are listed but no table: asked again, a model may find it."""
    rules = _RuleSet(parsed)
    rules.drop_people()
    rules.choose_table()
    rules.drop_behind_people()
    rules.resolve_containers()
    rules.drop_fillings()
    rules.drop_duplicates()
    rules.split_groups()
    return rules.detections(), tuple(rules.remarks)


class _RuleSet:
    """The rules one by one; each keeps `singles` and `composites` in the order of the answer."""

    def __init__(self, parsed: ParsedAnswer) -> None:
        self.singles: list[ParsedDetection] = [*parsed.detections]
        self.composites: list[ParsedComposite] = [*parsed.composites]
        self.table: ParsedDetection | None = None
        self.remarks: list[DetectionRemark] = [*parsed.remarks]
        reported = [entry.box for entry in parsed.detections if names_whole_person(entry.label)]
        self._people: Sequence[Box] = reported if parsed.people is None else parsed.people

    def detections(self) -> Detections:
        """Return the answer in the paper's schema: the table first, containers without contents among the singles."""
        empty = [composite.container for composite in self.composites if not composite.contents]
        singles = [*self.singles, *empty]
        table = [] if self.table is None else [_to_detection(replace(self.table, label="table"))]
        composites = [_to_composite(composite) for composite in self.composites if composite.contents]
        return Detections(detections=(*table, *map(_to_detection, singles)), composites=tuple(composites))

    def drop_people(self) -> None:
        """Drop people and parts of them; what was listed in such a `container` becomes single."""
        self.singles = [entry for entry in self.singles if not self._is_person(entry)]
        kept = []
        for composite in self.composites:
            contents = tuple(entry for entry in composite.contents if not self._is_person(entry))
            if self._is_person(composite.container):
                self.singles += contents
            else:
                kept.append(replace(composite, contents=contents))
        self.composites = kept

    def choose_table(self) -> None:
        """Take the box labelled as asked for the table, else the largest that is named one; it contains nothing.

        A label that may name something else ("surface", "white counter") counts where no other names a table.
        """
        entries = [*self.singles, *(composite.container for composite in self.composites)]
        is_table = names_table if any(names_table(entry.label) for entry in entries) else may_name_table
        for composite in [it for it in self.composites if is_table(it.container.label)]:
            self._remark(composite.container, "table_as_container", "what stands on a table is not in it")
            self.composites.remove(composite)
            self.singles += (composite.container, *composite.contents)
        tables = [entry for entry in self.singles if is_table(entry.label)]
        if not tables and (self.singles or self.composites):
            raise AnswerInvalidError(
                "no box is labelled 'table'. If the top of a table, desk or counter is visible, add it to `detections`"
                "; if there is none, give empty lists",
                NO_TABLE,
            )
        self.table = max(tables, key=lambda it: (names_table_exactly(it.label), compute_area(it.box)), default=None)
        others = [it for it in tables if it is not self.table and names_table(it.label)]
        for entry in others:
            self._remark(entry, "second_table", "another box is the table's")
        self.singles = [it for it in self.singles if it is not self.table and all(it is not other for other in others)]

    def drop_behind_people(self) -> None:
        """Drop what is not held and lies mostly in a person's box, also the table.

        Contents of a dropped container are judged by themselves: they may be held, or be in front.
        """
        self.singles = [entry for entry in self.singles if not self._is_behind(entry)]
        kept = []
        for composite in self.composites:
            if self._is_behind(composite.container):
                self.singles += [entry for entry in composite.contents if not self._is_behind(entry)]
            else:
                kept.append(composite)
        self.composites = kept
        if self.table is not None and self._is_behind(self.table):
            self.table = None

    def resolve_containers(self) -> None:
        """Make a container with non-solid contents one object; drop contents that lie apart from it."""
        for k, composite in enumerate(self.composites):
            holder = composite.container
            filling = (it for it in composite.contents if fills(it.label, holder.label, is_listed_in_it=True))
            matter = next(filling, None)
            apart = [entry for entry in composite.contents if intersect_boxes(entry.box, holder.box) <= 0]
            if matter is not None:
                self._remark(holder, "not_solid", f"one entry with {matter.label!r} in it")
                for entry in composite.contents:
                    self._remark(entry, "not_solid", f"one entry with {holder.label!r}")
                self.composites[k] = replace(composite, contents=())
            elif apart:
                for entry in apart:
                    self._remark(entry, "not_inside", f"apart from {holder.label!r}")
                self.singles += apart
                self.composites[k] = replace(composite, contents=tuple(t for t in composite.contents if t not in apart))
            elif not composite.contents:
                self._remark(holder, "empty_container", "one entry, for nothing is listed in it")

    def drop_fillings(self) -> None:
        """Drop a non-solid object in the box of a container that it fills; else it names its own container."""
        listed = (entry for composite in self.composites for entry in (composite.container, *composite.contents))
        others = [*self.singles, *listed]
        kept = []
        for entry in self.singles:
            if holder := next((it for it in others if _is_filled_with(it, entry)), None):
                self._remark(entry, "not_solid", f"what fills {holder.label!r}")
            else:
                kept.append(entry)
        self.singles = kept

    def drop_duplicates(self) -> None:
        """Keep every object once: as a container, else as contents, else as a single object."""
        self._merge_containers()
        holders = [composite.container for composite in self.composites]
        inside: list[ParsedDetection] = []
        for k, composite in enumerate(self.composites):
            contents: list[ParsedDetection] = []
            for entry in composite.contents:
                if self._is_new(entry, [*holders, *inside, *contents]):
                    contents.append(entry)
            self.composites[k] = replace(composite, contents=tuple(contents))
            inside += contents
        singles: list[ParsedDetection] = []
        for entry in self.singles:
            if self._is_new(entry, [*holders, *inside, *singles]) and not self._is_counted(entry):
                singles.append(entry)
        self.singles = singles

    def split_groups(self) -> None:
        """Count a box around all of several contents as one object: copies of it would be as many heaps."""
        for k, composite in enumerate(self.composites):
            contents = tuple(self._split_group(entry, composite.container) for entry in composite.contents)
            self.composites[k] = replace(composite, contents=contents)

    def _is_person(self, entry: ParsedDetection) -> bool:
        return names_person(entry.label) and self._remark(entry, "person", "a person, or a part of one")

    def _is_behind(self, entry: ParsedDetection) -> bool:
        share = max((compute_share_inside(entry.box, person) for person in self._people), default=0.0)
        if entry.held or share <= MAX_BEHIND:
            return False
        return self._remark(entry, "behind_person", f"{share:.0%} of its box lies in a person's, and it is not held")

    def _merge_containers(self) -> None:
        joined: list[ParsedComposite] = []
        for composite in self.composites:
            k = next((k for k, other in enumerate(joined) if _is_same(composite.container, other.container)), None)
            if k is None:
                joined.append(composite)
                continue
            self._remark(composite.container, "duplicate", f"the same as {joined[k].container.where}")
            joined[k] = replace(joined[k], contents=(*joined[k].contents, *composite.contents))
        self.composites = joined

    def _is_new(self, entry: ParsedDetection, others: Sequence[ParsedDetection]) -> bool:
        twin = next((other for other in others if _is_same(entry, other)), None)
        return twin is None or not self._remark(entry, "duplicate", f"the same as {twin.where}")

    def _is_counted(self, entry: ParsedDetection) -> bool:
        """Whether the object is one of those that the `count` of some contents stands for."""
        for composite in self.composites:
            for content in composite.contents:
                is_inside = compute_share_inside(entry.box, composite.container.box) >= INSIDE
                if content.count > 1 and is_inside and may_share_name(entry.label, content.label):
                    return self._remark(entry, "counted", f"one of the {content.count} of {content.where}")
        return False

    def _split_group(self, entry: ParsedDetection, container: ParsedDetection) -> ParsedDetection:
        share = compute_area(entry.box) / compute_area(container.box)
        if entry.count == 1 or share < GROUP_SHARE:
            return entry
        self._remark(entry, "group", f"its box is {share:.0%} of its container's: taken for one, not {entry.count}")
        return replace(entry, count=1)

    def _remark(self, entry: ParsedDetection, rule: str, detail: str) -> bool:
        """Add a remark; returns true, so that a rule can use it in its condition."""
        self.remarks.append(DetectionRemark(where=entry.where, label=entry.label, rule=rule, detail=detail[:500]))
        return True


def _is_same(a: ParsedDetection, b: ParsedDetection) -> bool:
    return compute_iou(a.box, b.box) >= SAME_BOX and may_share_name(a.label, b.label)


def _is_filled_with(container: ParsedDetection, content: ParsedDetection) -> bool:
    """Whether the content fills the container, by name and box."""
    if container is content or not fills(content.label, container.label, is_listed_in_it=False):
        return False
    return not names_non_solid(container.label) and compute_share_inside(content.box, container.box) >= INSIDE


def _to_detection(entry: ParsedDetection) -> Detection:
    return Detection(label=entry.label, bbox_xyxy=entry.box, score=entry.score, description=entry.description)


def _to_composite(composite: ParsedComposite) -> Composite:
    whole = composite.container
    holder = Container(label=whole.label, bbox=whole.box, description=whole.description)
    contents = tuple(
        Content(label=entry.label, bbox=entry.box, count=entry.count, description=entry.description)
        for entry in composite.contents
    )
    return Composite(description=composite.description, container=holder, contents=contents)
