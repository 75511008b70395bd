"""The embedded judge: rules over the geometry, no model and no weights."""

from schemas.config import CurateConfig
from schemas.curation import (
    CriterionScore,
    JudgeAnswer,
    PerCriterion,
    PhysicalProperties,
    Relabelling,
    Usability,
)
from tableverse_factory.curate.case import Case
from tableverse_factory.physics.materials import estimate_mass_kg


class RulesJudge:
    """Answers from the geometry and the labels alone."""

    def __init__(self, config: CurateConfig) -> None:
        self._config = config

    def answer(self, case: Case) -> JudgeAnswer:
        """The seven outputs."""
        ids = [str(index) for index in range(len(case.items))]
        score = CriterionScore(score=min(max(len(ids), 1), 10))
        return JudgeAnswer(
            usability=Usability(usable=True),
            label_confidence={i: item.confidence for i, item in zip(ids, case.items, strict=True)},
            physical_properties={
                i: PhysicalProperties(mass_kg=estimate_mass_kg(item.label, item.volume_m3, item.size))
                for i, item in zip(ids, case.items, strict=True)
            },
            per_criterion=PerCriterion(
                category_diversity=score, geometric_plausibility=score, graspability=score, layout_clarity=score
            ),
            object_relabeling={
                i: Relabelling(relabel_name=item.label) for i, item in zip(ids, case.items, strict=True)
            },
            final_score=score.score,
        )
