"""The stage `curate`: the judge's seven outputs, checked against the scene (paper section 3.3, appendix B)."""

import numpy as np

from schemas.config import Config
from schemas.outcome import Done, Dropped, Outcome
from schemas.scene import CuratedScene, SettledScene
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.models.services import Services
from tableverse_factory.stages.curate.agreement import compare_with_rules
from tableverse_factory.stages.curate.checks import assess_answer
from tableverse_factory.stages.curate.judge import JUDGES
from tableverse_factory.stages.curate.judge_input import build_judge_input


def curate(
    scene: SettledScene,
    config: Config,
    rng: np.random.Generator,  # noqa: ARG001
    services: Services,
) -> Outcome[CuratedScene]:
    """Asks the configured judge and checks the answer; low quality is recorded and never drops a scene.

    Drops: `judge_answer_missing` (nothing was recorded), `judge_answer_invalid` (no answer at all, also after a round
    of repair), `judge_answer_refused` (the model will not judge this picture).

    Raises:
        ModelAccessError: if a model's key or credit is refused.
        ModelError: if a model does not answer.
    """
    case = build_judge_input(scene, config.curate)
    judge = config.curate.judge
    try:
        judgement = JUDGES[judge](config.curate, services).judge(case)
    except AnswerInvalidError as error:
        return Dropped(f"judge_{error.reason}", str(error))
    verdict = assess_answer(judgement, case, config.curate)
    if judge != "rules":
        agreement = compare_with_rules(verdict, case, config.curate, services)
        verdict = verdict.model_copy(update={"agreement": agreement})
    return Done(CuratedScene(scene.scene_id, scene, judge, verdict))
