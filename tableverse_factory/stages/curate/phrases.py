"""Part F by rules: a name for every object, and phrases that are true of it and of no other object of the scene."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from schemas.curation import Relabelling, Relation
from tableverse_factory.geometry.relations.relations import relation_holds
from tableverse_factory.stages.curate.appearance import DescribedObject, may_be_called, name_shape
from tableverse_factory.stages.curate.lexicon import (
    COLORS,
    find_color_words,
    find_head_noun,
    is_generic,
    may_share_noun,
    split_label,
)

MAX_PHRASES = 8
OWN_COLOR = 0.55  # least surface share of a colour for an object to be called by it
FOREIGN_COLOR = 0.25  # least share from which a colour might be said of an object: who counts may count it then
SECOND_COLOR = 0.4  # the same of one that has most of another colour, where only one object is asked for
MARGIN_M = 0.02
MARGIN_RATIO = 1.25
_MIN_STEP_M = 0.01
_TRUSTED = 0.5
_ORDINALS = ("second", "third")  # ordinals that people use at a table


def name_objects(items: Sequence[DescribedObject], confidence: Sequence[float]) -> tuple[Relabelling, ...]:
    """Name every object and list its distinguishing phrases, in order."""
    namer = ObjectNamer(items, confidence)
    return tuple(
        Relabelling(relabel_name=name, distinguishing_phrases=namer.phrases(index))
        for index, name in enumerate(namer.names)
    )


class ObjectNamer:
    """Names of a scene's objects, and the phrases that may refer to each."""

    def __init__(self, items: Sequence[DescribedObject], confidence: Sequence[float]) -> None:
        self._items = items
        self.names = tuple(_choose_name(item, sure) for item, sure in zip(items, confidence, strict=True))

    def phrases(self, index: int) -> tuple[str, ...]:
        """List at most `MAX_PHRASES` noun phrases true of this object alone, the simplest first."""
        found: list[str] = []
        for phrase, whom in self._propose_phrases(index):
            if whom == [index] and phrase not in found:
                found.append(phrase)
            if len(found) == MAX_PHRASES:
                break
        return tuple(found)

    def matching(self, name: str) -> list[int]:
        """List the objects that a bare name may mean: same noun or a synonym, with at least the name's other words."""
        return [j for j in range(len(self._items)) if self._may_mean(name, j)]

    def _may_mean(self, name: str, j: int) -> bool:
        if not all(self._may_be(color, j) for color in find_color_words(name)):
            return False
        if is_generic(name):
            return True  # anything is an object, and a spoon is a long one
        head, item = find_head_noun(name), self._items[j]
        if is_generic(self.names[j]):
            return may_be_called(head, item.body, item.size, item.volume_m3)
        same = may_share_noun(head, find_head_noun(self.names[j]))
        return same and _list_modifiers(name) <= set(split_label(self.names[j]))

    def _may_be(self, color: str, j: int) -> bool:
        item = self._items[j]
        if color in find_color_words(self.names[j]) or not item.colors:
            return True
        return item.colors[color] >= FOREIGN_COLOR

    def _has_other_color(self, noun: str, j: int) -> bool:
        """Whether an object has a colour that a noun does not name: shading and prints of it have smaller shares."""
        own, main = self._items[j].colors, find_main_color(self._items[j])
        foreign = [color for color in find_color_words(noun) if color not in find_color_words(self.names[j])]
        return main is not None and any(color != main and own[color] < SECOND_COLOR for color in foreign)

    def _is_called(self, noun: str, j: int) -> bool:
        """Whether the object clearly goes by this noun; everything on the table is an `object`."""
        own, main = self.names[j], find_main_color(self._items[j])
        same = find_head_noun(noun) == find_head_noun(own) or is_generic(noun)
        colored = all(color in find_color_words(own) or color == main for color in find_color_words(noun))
        return same and colored and _list_modifiers(noun) <= set(split_label(own))

    def _propose_phrases(self, index: int) -> Iterator[tuple[str, list[int]]]:
        """Propose phrases, each with all objects that it may mean."""
        yield from self._propose_simple(index)
        yield from self._propose_relations(index, self.names[index], self.matching(self.names[index]))
        for noun, group in self._list_nouns(index):
            if len(group) > 2 and all(self._is_called(noun, j) for j in group):
                yield from self._propose_ordinals(index, noun, group)

    def _propose_simple(self, index: int) -> Iterator[tuple[str, list[int]]]:
        """Propose phrases that refer to no other object."""
        nouns = self._list_nouns(index)
        for noun, group in nouns:
            yield f"the {noun}", [j for j in group if not self._has_other_color(noun, j)]
        for noun, group in nouns:
            if len(group) > 1:
                yield from self._propose_superlatives(index, noun, group)

    def _list_nouns(self, index: int) -> list[tuple[str, list[int]]]:
        """List the name, and the name with its colour, each with all objects that it may mean."""
        name = self.names[index]
        matching = self.matching(name)
        color = find_main_color(self._items[index])
        if not color or find_color_words(name):
            return [(name, matching)]
        return [(name, matching), (f"{color} {name}", [j for j in matching if self._may_be(color, j)])]

    def _propose_superlatives(self, index: int, name: str, matching: list[int]) -> Iterator[tuple[str, list[int]]]:
        for template, measure, is_ratio in _SUPERLATIVES:
            values = {j: measure(self._items[j]) for j in matching}
            rivals = max(values[j] for j in matching if j != index)
            ahead = values[index] >= MARGIN_RATIO * rivals if is_ratio else values[index] >= rivals + MARGIN_M
            if ahead:
                yield template.format(name), [index]

    def _propose_relations(self, index: int, name: str, matching: list[int]) -> Iterator[tuple[str, list[int]]]:
        """Propose phrases by what the object is in, on or next to, where that has a phrase of its own."""
        beside = (Relation.NEXT_TO,) if len(matching) > 1 else ()
        for relation in (Relation.IN, Relation.ON, *beside):
            for other, item in enumerate(self._items):
                if other == index or not relation_holds(relation, self._items[index].body, item.body):
                    continue
                landmark = next((phrase for phrase, whom in self._propose_simple(other) if whom == [other]), None)
                if landmark is not None:
                    rivals = (j for j in matching if j != other)
                    whom = [j for j in rivals if relation_holds(relation, self._items[j].body, item.body)]
                    yield f"the {name} {relation.value} {landmark}", whom

    def _propose_ordinals(self, index: int, name: str, matching: list[int]) -> Iterator[tuple[str, list[int]]]:
        for axis, end in ((0, "from the left"), (1, "from the camera")):
            places = {j: float(_compute_middle(self._items[j])[axis]) for j in matching}
            order = sorted(matching, key=lambda j: (places[j], j))
            steps = np.diff([places[j] for j in order])
            rank = order.index(index)
            if 0 < rank <= len(_ORDINALS) and float(steps.min()) >= _MIN_STEP_M:
                yield f"the {_ORDINALS[rank - 1]} {name} {end}", [index]


def find_main_color(item: DescribedObject) -> str | None:
    """Find the colour that most of the surface has; None where none dominates."""
    if not item.colors:
        return None
    best = max(COLORS, key=lambda name: item.colors[name])
    return best if item.colors[best] >= OWN_COLOR else None


def _choose_name(item: DescribedObject, confidence: float) -> str:
    if not is_generic(item.label) and confidence >= _TRUSTED:
        return " ".join(split_label(item.label)[:6])
    shape = name_shape(item.body, item.size, item.volume_m3)
    color = find_main_color(item)
    return f"{color} {shape}" if color else shape


def _list_modifiers(name: str) -> set[str]:
    return set(split_label(name)) - {find_head_noun(name), "gray"} - set(COLORS)


def _compute_middle(item: DescribedObject) -> np.ndarray:
    return (item.body.low + item.body.high) / 2


_SUPERLATIVES: tuple[tuple[str, Callable[[DescribedObject], float], bool], ...] = (
    ("the largest {}", lambda item: float(np.prod(item.size)), True),
    ("the smallest {}", lambda item: 1.0 / max(float(np.prod(item.size)), 1e-12), True),
    ("the tallest {}", lambda item: float(item.body.high[2] - item.body.low[2]), True),
    ("the leftmost {}", lambda item: -float(_compute_middle(item)[0]), False),
    ("the rightmost {}", lambda item: float(_compute_middle(item)[0]), False),
    ("the {} nearest to the camera", lambda item: -float(_compute_middle(item)[1]), False),
    ("the {} farthest from the camera", lambda item: float(_compute_middle(item)[1]), False),
    ("the topmost {}", lambda item: float(item.body.low[2]), False),
)
