"""Check of a judge's answer against the scene: the verdict goes into the dataset, not the answer.

Whatever an answer holds, the verdict is bounded, names only the scene's objects, and has a reason for each refusal.
"""

import math
import re
from collections import Counter
from collections.abc import Iterator
from functools import partial

from schemas.config import CurateConfig
from schemas.curation import HINGE_CATEGORIES, Assessment, JudgeAnswer, JudgeRemark, ObjectAssessment, Relabelling
from schemas.identity import clean_label
from tableverse_factory.physics.bodies.materials import compute_mass_bounds_kg
from tableverse_factory.stages.curate.interfaces import Judgement
from tableverse_factory.stages.curate.judge_input import JudgeInput
from tableverse_factory.stages.curate.labels import estimate_label_confidence, estimate_physical_properties
from tableverse_factory.stages.curate.phrases import name_objects
from tableverse_factory.stages.curate.score import UNUSABLE_CAP, WEIGHTS, weigh_criteria
from tableverse_factory.stages.curate.task_checks import check_tasks
from tableverse_factory.stages.curate.twin_check import TwinCheck

MAX_PHRASES = 20
MAX_REMARKS = 100
_PARTS = ("label_confidence", "physical_properties", "object_relabeling")
_OFF_CRITERIA = 2.0  # difference between the final score and the weighted criteria that is worth a remark [points]
_INDEX = re.compile(r"\s*[_#]\s*\d+$")  # of a renderer


def assess_answer(judgement: Judgement, case: JudgeInput, config: CurateConfig) -> Assessment:
    """Check a judge's answer and return the verdict."""
    answer = judgement.answer
    objects = _assess_objects(answer, case)
    codes = case.twin.reason_codes
    usable = answer.usability.usable and not answer.usability.reason_codes and not codes
    score = min(answer.final_score, case.twin.most_points, 10 if usable else UNUSABLE_CAP)
    remarks = (
        *_remark_on_gate(answer),
        *_remark_on_twin(answer, case.twin),
        *_remark_on_ids(answer, case),
        *_remark_on_objects(answer, objects),
    )
    return Assessment(
        usable=usable,
        reason_codes=tuple(sorted({*answer.usability.reason_codes, *codes})),
        severe_label_error=any(o.label_error for o in objects),
        quality_score=score,
        criterion_scores={name: getattr(answer.per_criterion, name).score for name in WEIGHTS},
        objects=objects,
        tasks=check_tasks(answer, case, objects, config.judge),
        answered_usable=answer.usability.usable,
        answered_score=answer.final_score,
        remarks=remarks[:MAX_REMARKS],
        origin=judgement.origin,
        answer_json=judgement.text,
    )


def _assess_objects(answer: JudgeAnswer, case: JudgeInput) -> tuple[ObjectAssessment, ...]:
    """Assess each object of the scene, in order; what the answer lacks comes from the rules and is marked."""
    given, confidence = answer.object_relabeling, answer.label_confidence
    sure = tuple(confidence.get(str(i), estimate_label_confidence(item)) for i, item in enumerate(case.items))
    complete = all(str(i) in given for i in range(len(case.items)))
    ruled = () if complete else name_objects(case.items, sure)
    names = [given.get(str(i)) or ruled[i] for i in range(len(case.items))]
    phrases = Counter(phrase.casefold() for name in names for phrase in set(name.distinguishing_phrases))
    shared = {phrase for phrase, count in phrases.items() if count > 1}
    return tuple(_assess_object(answer, case, index, sure[index], name, shared) for index, name in enumerate(names))


def _assess_object(
    answer: JudgeAnswer, case: JudgeInput, index: int, sure: float, name: Relabelling, shared: set[str]
) -> ObjectAssessment:
    """Assess one object; `shared` phrases are said of several objects."""
    key, item = str(index), case.items[index]
    errors = answer.severe_label_error
    wrong = errors.has_severe_label_error and index in errors.evidence_ids
    answered = answer.physical_properties.get(key)
    physical = answered or estimate_physical_properties(item)
    low, high = compute_mass_bounds_kg(item.volume_m3, item.size)
    mass = min(max(physical.mass_kg, low), high) if math.isfinite(physical.mass_kg) else low
    hinge = physical.hinge_category if physical.hinge_category in HINGE_CATEGORIES else None
    own = dict.fromkeys(phrase for phrase in name.distinguishing_phrases if phrase.casefold() not in shared)
    return ObjectAssessment(
        object_id=item.object_id,
        relabel_name=clean_label(_INDEX.sub("", name.relabel_name)),
        distinguishing_phrases=tuple(own)[:MAX_PHRASES],
        label_confidence=sure,
        label_error=wrong,
        corrected_label=errors.correct_labels.get(key, "") if wrong else "",
        mass_kg=mass,
        answered_mass_kg=None if answered is None else answered.mass_kg,
        mass_clipped=mass != physical.mass_kg,
        has_hinge=physical.has_hinge,
        hinge_category=hinge if physical.has_hinge else None,
        graspable=case.feasibility.is_graspable(index, mass),
        bad_geometry=index in answer.per_criterion.geometric_plausibility.bad_geometry_ids,
        non_tabletop=index in answer.usability.evidence_ids.get("NON_TABLETOP_OBJECT", ()),
        from_rules=tuple(part for part in _PARTS if key not in getattr(answer, part)),
    )


def _remark_on_gate(answer: JudgeAnswer) -> Iterator[JudgeRemark]:
    """Remark where gate, reasons and score contradict one another."""
    gate, weighted = answer.usability, weigh_criteria(answer.per_criterion)
    if gate.usable and gate.reason_codes:
        yield JudgeRemark(code="gate_contradicts_reasons", detail=", ".join(gate.reason_codes[:4]))
    if not gate.usable and not gate.reason_codes:
        yield JudgeRemark(code="gate_without_reason")
    usable = gate.usable and not gate.reason_codes
    if not usable and answer.final_score > UNUSABLE_CAP:
        yield JudgeRemark(code="score_capped", detail=f"{answer.final_score} for an unusable scene")
    elif usable and abs(answer.final_score - weighted) > _OFF_CRITERIA:
        detail = f"{answer.final_score}, but its criteria give {weighted:.1f}"
        yield JudgeRemark(code="score_off_criteria", detail=detail)


def _remark_on_twin(answer: JudgeAnswer, twin: TwinCheck) -> Iterator[JudgeRemark]:
    """Remark where the comparison with the photograph overrules the answer."""
    if twin.reason_codes and answer.usability.usable:
        yield JudgeRemark(code="gate_overruled", detail=", ".join(twin.reason_codes))
    if answer.final_score > twin.most_points:
        yield JudgeRemark(code="score_capped", detail=f"{answer.final_score}, but the twin allows {twin.most_points}")


def _remark_on_ids(answer: JudgeAnswer, case: JudgeInput) -> Iterator[JudgeRemark]:
    criteria = answer.per_criterion
    lists = {
        "usability": [i for ids in answer.usability.evidence_ids.values() for i in ids],
        "severe_label_error": [*answer.severe_label_error.evidence_ids],
        "geometric_plausibility": [*criteria.geometric_plausibility.bad_geometry_ids],
        "graspability": [*criteria.graspability.graspable_ids, *criteria.graspability.ungraspable_ids],
        **{part: [int(key) for key in getattr(answer, part)] for part in _PARTS},
    }
    for part, ids in lists.items():
        unknown = sorted({index for index in ids if not 0 <= index < len(case.items)})
        if unknown:
            shown = ", ".join(str(index)[:24] for index in unknown[:5])
            yield JudgeRemark(code="unknown_id", detail=f"{part}: {shown}")


def _remark_on_objects(answer: JudgeAnswer, objects: tuple[ObjectAssessment, ...]) -> Iterator[JudgeRemark]:
    """Remark on what was filled, clipped or left out, object by object."""
    for index, verdict in enumerate(objects):
        remark = partial(JudgeRemark, object_id=verdict.object_id)
        yield from (remark(code="filled_from_rules", detail=part) for part in verdict.from_rules)
        if verdict.mass_clipped and verdict.answered_mass_kg is not None:
            detail = f"{verdict.answered_mass_kg:.4g} kg became {verdict.mass_kg:.4g} kg"
            yield remark(code="mass_clipped", detail=detail)
        physical = answer.physical_properties.get(str(index))
        if physical and physical.has_hinge and physical.hinge_category not in (*HINGE_CATEGORIES, None):
            yield remark(code="unknown_hinge")
        name = answer.object_relabeling.get(str(index))
        if name is not None and name.relabel_name != verdict.relabel_name:
            yield remark(code="index_in_name", detail=name.relabel_name)
        if name is not None and len(set(name.distinguishing_phrases)) > len(verdict.distinguishing_phrases):
            yield remark(code="phrase_of_several")
