"""Answers are checked against the scene: what the dataset says is the verdict, not the answer.

Whatever an answer holds, the verdict is bounded, names only the scene's objects, and has a reason for each refusal.
"""

import math
import re

from schemas.config import CurateConfig
from schemas.curation import (
    HINGE_CATEGORIES,
    Assessment,
    GeneratedTask,
    JudgeAnswer,
    ObjectAssessment,
    Relation,
    TaskAssessment,
)
from tableverse_factory.curate.case import Case, Item
from tableverse_factory.curate.labels import label_confidence
from tableverse_factory.curate.phrases import relabel
from tableverse_factory.curate.physical import physical_properties
from tableverse_factory.curate.score import UNUSABLE_CAP, WEIGHTS
from tableverse_factory.physics.materials import mass_bounds_kg

MAX_ANSWER_CHARS = 65_536
MAX_PHRASES = 20
MAX_INSTRUCTION_CHARS = 300
MAX_TASKS = 200
"""Tasks of one answer that are looked at; the rest are counted out as `too_many`."""

_RELATIONS = {relation.value: relation for relation in Relation}


def assess(answer: JudgeAnswer, case: Case, config: CurateConfig) -> Assessment:
    """The verdict on an answer, whoever gave it."""
    objects = _objects(answer, case)
    usable = answer.usability.usable and not answer.usability.reason_codes
    return Assessment(
        usable=usable,
        reason_codes=tuple(sorted(set(answer.usability.reason_codes))),
        severe_label_error=any(o.label_error for o in objects),
        quality_score=min(answer.final_score, 10 if usable else UNUSABLE_CAP),
        criterion_scores={name: getattr(answer.per_criterion, name).score for name in WEIGHTS},
        objects=objects,
        tasks=_tasks(answer, case, tuple(o.mass_kg for o in objects), config.judge),
        answer_json=answer.model_dump_json(by_alias=True)[:MAX_ANSWER_CHARS],
    )


def _objects(answer: JudgeAnswer, case: Case) -> tuple[ObjectAssessment, ...]:
    """A verdict for each object of the scene, in order; what the answer lacks comes from the rules and is marked."""
    sure = tuple(answer.label_confidence.get(str(i), label_confidence(item)) for i, item in enumerate(case.items))
    complete = all(str(i) in answer.object_relabeling for i in range(len(case.items)))
    names = () if complete else relabel(case, sure)
    wrong = set(answer.severe_label_error.evidence_ids) if answer.severe_label_error.has_severe_label_error else set()
    bad = set(answer.per_criterion.geometric_plausibility.bad_geometry_ids)
    objects = []
    for index, item in enumerate(case.items):
        key = str(index)
        filled = tuple(
            part
            for part in ("label_confidence", "physical_properties", "object_relabeling")
            if key not in getattr(answer, part)
        )
        name = answer.object_relabeling[key] if key in answer.object_relabeling else names[index]
        physical = answer.physical_properties.get(key) or physical_properties(item)
        mass, clipped = possible_mass_kg(physical.mass_kg, item)
        hinge = physical.hinge_category if physical.hinge_category in HINGE_CATEGORIES else None
        objects.append(
            ObjectAssessment(
                object_id=item.object_id,
                relabel_name=name.relabel_name,
                distinguishing_phrases=tuple(dict.fromkeys(name.distinguishing_phrases))[:MAX_PHRASES],
                label_confidence=sure[index],
                label_error=index in wrong,
                corrected_label=answer.severe_label_error.correct_labels.get(key, "") if index in wrong else "",
                mass_kg=mass,
                mass_clipped=clipped,
                has_hinge=physical.has_hinge,
                hinge_category=hinge if physical.has_hinge else None,
                graspable=case.able.graspable(index, mass),
                bad_geometry=index in bad,
                from_rules=filled,
            )
        )
    return tuple(objects)


def possible_mass_kg(mass_kg: float, item: Item) -> tuple[float, bool]:
    """The mass within what the volume allows, and whether it had to be clipped."""
    low, high = mass_bounds_kg(item.volume_m3, item.size)
    possible = min(max(mass_kg, low), high) if math.isfinite(mass_kg) else low
    return possible, possible != mass_kg


def _tasks(answer: JudgeAnswer, case: Case, masses_kg: tuple[float, ...], source: str) -> tuple[TaskAssessment, ...]:
    """Every task of the answer with its verdict, in the answer's order."""
    seen: set[tuple[int, str, int]] = set()
    tasks = []
    for number, task in enumerate(answer.generated_tasks):
        triple = (task.x_id, task.relation, task.y_id)
        refusal = (
            "too_many" if number >= MAX_TASKS else "repeated" if triple in seen else _refusal(task, case, masses_kg)
        )
        seen.add(triple)
        tasks.append(
            TaskAssessment(
                task_id=f"task_{number:03d}",
                instruction=_one_line(task.instruction),
                x_id=_id_of(task.x_id, case),
                y_id=_id_of(task.y_id, case),
                relation=_one_line(task.relation),
                source=source,
                accepted=not refusal,
                refusal=refusal,
            )
        )
    return tuple(tasks)


def _refusal(task: GeneratedTask, case: Case, masses_kg: tuple[float, ...]) -> str:
    """Why a task is refused; empty if it holds every hard constraint."""
    count = len(case.items)
    if not (0 <= task.x_id < count and 0 <= task.y_id < count):
        return "unknown_id"
    if task.x_id == task.y_id:
        return "same_object"
    if task.relation not in _RELATIONS:
        return "unknown_relation"
    if not fits_template(task):
        return "broken_template"
    return case.able.refusal(_RELATIONS[task.relation], task.x_id, task.y_id, masses_kg[task.x_id])


def fits_template(task: GeneratedTask) -> bool:
    """Whether the instruction is the paper's template filled with the task's own names; an article may precede them."""
    name_x, name_y = (re.escape(_bare(name)) for name in (task.x_name, task.y_name))
    article = "(?:the |a |an )?"
    pattern = f"Pick up {article}{name_x} and place it {re.escape(task.relation)} {article}{name_y}\\.?"
    return re.fullmatch(pattern, task.instruction, re.IGNORECASE) is not None


def _bare(name: str) -> str:
    return re.sub(r"^(the|a|an) ", "", name, flags=re.IGNORECASE)


def _id_of(index: int, case: Case) -> str:
    """The object's id; the number itself, as text, where there is no such object."""
    return case.items[index].object_id if 0 <= index < len(case.items) else str(index)[:24]


def _one_line(text: str) -> str:
    printable = "".join(c if c.isprintable() else " " for c in text[:MAX_INSTRUCTION_CHARS])
    return " ".join(printable.split())
