"""Part G by rules: pick-and-place tasks that meet every hard constraint, as diverse as the scene allows."""

from collections import Counter
from collections.abc import Iterator

from schemas.curation import GeneratedTask, Relation
from tableverse_factory.geometry.relations.relations import is_inside, relation_nearly_holds
from tableverse_factory.stages.curate.appearance import can_roll
from tableverse_factory.stages.curate.judge_input import JudgeInput
from tableverse_factory.stages.curate.lexicon import CARRIES, CONTENTS, classify_label

TEMPLATE = "Pick up {x} and place it {relation} {y}"
MAX_TRIES = 160
"""Most triples tested: bounds the time in scenes where little is possible."""

_SMALL_REFERENCE = 1 / 3
_CONTAINING = (Relation.IN, Relation.INTO, Relation.INSIDE)
_ORDER = (
    *(Relation.IN, Relation.ON, Relation.NEXT_TO, Relation.LEFT, Relation.BEHIND, Relation.OUTSIDE),
    *(Relation.INTO, Relation.RIGHT, Relation.IN_FRONT, Relation.INSIDE),
)
_LEVEL_SUPPORTS = ("dish", "storage")

Triple = tuple[int, Relation, int]


def generate_tasks(
    case: JudgeInput,
    names: tuple[str, ...],
    phrases: tuple[tuple[str, ...], ...],
    masses_kg: tuple[float, ...],
    limit: int,
) -> tuple[GeneratedTask, ...]:
    """Generate at most `limit` tasks, the relations in turn, each for the objects with the fewest tasks so far.

    Args:
        case: The scene.
        names: Name of each object, from part F.
        phrases: Distinguishing phrases of each object; one without any is part of no task.
        masses_kg: Mass of each object.
        limit: Most tasks.
    """
    open_triples = {relation: list(_list_plausible(case, names, phrases, masses_kg, relation)) for relation in _ORDER}
    uses: Counter[int] = Counter()
    pairs: Counter[tuple[int, int]] = Counter()
    chosen: list[Triple] = []
    tries = 0
    while any(open_triples.values()) and len(chosen) < limit and tries < MAX_TRIES:
        for relation in _ORDER:
            found = False
            while open_triples[relation] and not found and tries < MAX_TRIES and len(chosen) < limit:
                triple = min(open_triples[relation], key=lambda t: (pairs[t[0], t[2]], uses[t[0]] + uses[t[2]], t))
                open_triples[relation].remove(triple)
                tries += 1
                found = not case.feasibility.explain_refusal(relation, triple[0], triple[2], masses_kg[triple[0]])
            if found:
                chosen.append(triple)
                uses.update((triple[0], triple[2]))
                pairs[triple[0], triple[2]] += 1
                if relation in _CONTAINING:
                    # In, into and inside ask for the same: once is enough.
                    for same in _CONTAINING:
                        pair = (triple[0], triple[2])
                        open_triples[same] = [t for t in open_triples[same] if (t[0], t[2]) != pair]
    return tuple(_build_task(triple, phrases) for triple in chosen)


def _list_plausible(
    case: JudgeInput,
    names: tuple[str, ...],
    phrases: tuple[tuple[str, ...], ...],
    masses_kg: tuple[float, ...],
    relation: Relation,
) -> Iterator[Triple]:
    """List triples worth testing: nameable, pickable, sensible in daily life, and clearly not satisfied already."""
    kinds = [classify_label(name) for name in names]
    indices = [index for index, own in enumerate(phrases) if own]
    for x in indices:
        if case.feasibility.explain_pick_refusal(x, masses_kg[x]):
            continue
        for y in indices:
            if x != y and _is_sensible(case, kinds, relation, x, y):
                yield (x, relation, y)


def _is_sensible(case: JudgeInput, kinds: list[str], relation: Relation, x: int, y: int) -> bool:
    item, reference = case.items[x], case.items[y]
    if relation_nearly_holds(relation, item.body, reference.body):
        return False
    if relation in _CONTAINING:
        return kinds[x] in CONTENTS.get(kinds[y], ()) and reference.body.cavity is not None
    if relation is Relation.ON:
        level = kinds[y] in _LEVEL_SUPPORTS or not can_roll(item.body)
        return kinds[x] in CARRIES.get(kinds[y], ()) and reference.body.cavity is None and level
    if relation is Relation.OUTSIDE:
        return is_inside(item.body, reference.body)
    if is_inside(reference.body, item.body):
        return False
    return float(reference.size.max()) >= _SMALL_REFERENCE * float(item.size.max())


def _build_task(triple: Triple, phrases: tuple[tuple[str, ...], ...]) -> GeneratedTask:
    x, relation, y = triple
    instruction = TEMPLATE.format(x=phrases[x][0], relation=relation.value, y=phrases[y][0])
    return GeneratedTask(
        instruction=instruction,
        X_id=x,
        X_name=phrases[x][0],
        Y_id=y,
        Y_name=phrases[y][0],
        relation=relation.value,
    )
