"""Answers are checked against the scene: what the dataset says is the verdict, not the answer."""

from schemas.config import CurateConfig
from schemas.curation import Assessment, JudgeAnswer, ObjectAssessment
from tableverse_factory.curate.case import Case


def assess(answer: JudgeAnswer, case: Case, config: CurateConfig) -> Assessment:
    """The verdict on an answer."""
    objects = []
    for index, item in enumerate(case.items):
        key = str(index)
        physical = answer.physical_properties[key]
        objects.append(
            ObjectAssessment(
                object_id=item.object_id,
                relabel_name=answer.object_relabeling[key].relabel_name,
                label_confidence=answer.label_confidence[key],
                mass_kg=physical.mass_kg,
                has_hinge=physical.has_hinge,
                hinge_category=physical.hinge_category,
            )
        )
    return Assessment(
        usable=answer.usability.usable,
        quality_score=answer.final_score if answer.usability.usable else min(answer.final_score, 4),
        criterion_scores={"category_diversity": answer.per_criterion.category_diversity.score},
        objects=tuple(objects),
        tasks=(),
        answer_json=answer.model_dump_json(by_alias=True),
    )
