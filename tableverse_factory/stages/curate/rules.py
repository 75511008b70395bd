"""The judge `rules`: geometry and labels alone, no model and no weights."""

from schemas.config import CurateConfig
from schemas.curation import JudgeAnswer
from tableverse_factory.models.services import Services
from tableverse_factory.stages.curate.interfaces import Judgement
from tableverse_factory.stages.curate.judge_input import JudgeInput
from tableverse_factory.stages.curate.labels import (
    estimate_label_confidence,
    estimate_physical_properties,
    find_label_errors,
)
from tableverse_factory.stages.curate.phrases import name_objects
from tableverse_factory.stages.curate.score import compute_final_score, score_criteria
from tableverse_factory.stages.curate.tasks import generate_tasks
from tableverse_factory.stages.curate.usability import judge_usability


class RulesJudge:
    """Answers in the paper's schema from measurements and the lexicon."""

    def __init__(self, config: CurateConfig, services: Services) -> None:  # noqa: ARG002
        self._config = config

    def judge(self, case: JudgeInput) -> Judgement:
        """Judge the scene; the text is the answer as JSON."""
        answer = self.answer(case)
        return Judgement(answer, answer.model_dump_json(by_alias=True))

    def answer(self, case: JudgeInput) -> JudgeAnswer:
        """Give the seven outputs (paper appendix B)."""
        count, ids = len(case.items), [str(index) for index in range(len(case.items))]
        usability = judge_usability(case)
        confidence = tuple(estimate_label_confidence(item) for item in case.items)
        physical = tuple(estimate_physical_properties(item) for item in case.items)
        masses = tuple(properties.mass_kg for properties in physical)
        graspable = tuple(index for index in range(count) if case.feasibility.is_graspable(index, masses[index]))
        names = name_objects(case.items, confidence)
        plain = tuple(name.relabel_name for name in names)
        criteria = score_criteria(case, plain, graspable, "EXTREME_REGIONAL_PARTITION" in usability.reason_codes)
        return JudgeAnswer(
            usability=usability,
            severe_label_error=find_label_errors(case),
            label_confidence=dict(zip(ids, confidence, strict=True)),
            physical_properties=dict(zip(ids, physical, strict=True)),
            per_criterion=criteria,
            object_relabeling=dict(zip(ids, names, strict=True)),
            final_score=compute_final_score(criteria, count, usability.usable),
            generated_tasks=generate_tasks(case, names, masses, self._config.max_tasks),
        )
