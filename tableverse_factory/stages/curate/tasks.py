"""Part G by rules: pick-and-place tasks that meet every hard constraint, as diverse as the scene allows."""

from collections import Counter

from schemas.curation import INSTRUCTION, GeneratedTask, Relabelling, Relation
from tableverse_factory.geometry.relations.relations import is_inside, relation_nearly_holds
from tableverse_factory.stages.curate.appearance import can_roll
from tableverse_factory.stages.curate.judge_input import JudgeInput
from tableverse_factory.stages.curate.lexicon import CARRIES, CONTENTS, classify_label

MAX_TRIES = 160  # most triples tested: bounds the time in scenes where little is possible
_SMALL_REFERENCE = 1 / 3
_CONTAINING = (Relation.IN, Relation.INTO, Relation.INSIDE)
_ORDER = (
    *(Relation.IN, Relation.ON, Relation.NEXT_TO, Relation.LEFT, Relation.BEHIND, Relation.OUTSIDE),
    *(Relation.INTO, Relation.RIGHT, Relation.IN_FRONT, Relation.INSIDE),
)
_LEVEL_SUPPORTS = ("dish", "storage")

Triple = tuple[int, Relation, int]


def generate_tasks(
    case: JudgeInput, names: tuple[Relabelling, ...], masses_kg: tuple[float, ...], limit: int
) -> tuple[GeneratedTask, ...]:
    """Generate at most `limit` tasks, the relations in turn, each for the objects with the fewest tasks so far.

    Objects without distinguishing phrases are part of no task.
    """
    kinds = [classify_label(name.relabel_name) for name in names]
    named = [index for index, name in enumerate(names) if name.distinguishing_phrases]
    pickable = [x for x in named if not case.feasibility.explain_pick_refusal(x, masses_kg[x])]
    candidates = [(x, y) for x in pickable for y in named if x != y]
    open_triples = {
        relation: [(x, relation, y) for x, y in candidates if _is_sensible(case, kinds, relation, x, y)]
        for relation in _ORDER
    }
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
                for same in _CONTAINING if relation in _CONTAINING else ():  # they ask for the same: once is enough
                    left = open_triples[same]
                    open_triples[same] = [t for t in left if (t[0], t[2]) != (triple[0], triple[2])]
    return tuple(_build_task(triple, names) for triple in chosen)


def _is_sensible(case: JudgeInput, kinds: list[str], relation: Relation, x: int, y: int) -> bool:
    """Whether the task makes sense in daily life, and is clearly not done already."""
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


def _build_task(triple: Triple, names: tuple[Relabelling, ...]) -> GeneratedTask:
    x, relation, y = triple
    name_x, name_y = names[x].distinguishing_phrases[0], names[y].distinguishing_phrases[0]
    instruction = INSTRUCTION.format(x=name_x, relation=relation.value, y=name_y)
    return GeneratedTask(instruction=instruction, X_id=x, X_name=name_x, Y_id=y, Y_name=name_y, relation=relation.value)
