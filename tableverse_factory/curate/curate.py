"""The stage `curate`: the judge's seven outputs, checked against the scene (paper section 3.3, appendix B)."""

import numpy as np

from schemas.config import Config
from schemas.outcome import Done, Dropped, Outcome
from schemas.scene import CuratedScene, SettledScene
from tableverse_factory.curate.case import case_of
from tableverse_factory.curate.checks import assess
from tableverse_factory.curate.invalid import AnswerInvalid
from tableverse_factory.curate.judge import JUDGES
from tableverse_factory.services import Services


def curate(
    scene: SettledScene,
    config: Config,
    rng: np.random.Generator,  # noqa: ARG001
    services: Services,  # noqa: ARG001
) -> Outcome[CuratedScene]:
    """Asks the configured judge and checks the answer; low quality is recorded and never drops a scene.

    Drops: `judge_answer_missing`, `judge_answer_invalid` (a recorded answer that is absent or no answer at all).
    """
    case = case_of(scene, config.curate)
    try:
        answer = JUDGES[config.curate.judge](config.curate).answer(case)
    except AnswerInvalid as error:
        return Dropped(error.reason, str(error))
    assessment = assess(answer, case, config.curate)
    return Done(CuratedScene(scene.scene_id, scene, config.curate.judge, assessment))
