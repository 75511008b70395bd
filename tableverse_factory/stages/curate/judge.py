"""The door `Judge`: who answers for a scene."""

from collections.abc import Callable
from typing import Protocol

from schemas.config import CurateConfig
from tableverse_factory.models.services import Services
from tableverse_factory.stages.curate.judge_input import JudgeInput
from tableverse_factory.stages.curate.judgement import Judgement
from tableverse_factory.stages.curate.model import ModelJudge
from tableverse_factory.stages.curate.replay import ReplayJudge
from tableverse_factory.stages.curate.rules import RulesJudge


class Judge(Protocol):
    """Answers in the paper's schema; ids are the indices of the case's items."""

    def judge(self, case: JudgeInput) -> Judgement:
        """The seven outputs.

        Raises:
            AnswerInvalidError: if there is no answer, or it is beyond repair.
            ModelError: if a model does not answer.
        """
        ...


JUDGES: dict[str, Callable[[CurateConfig, Services], Judge]] = {
    "rules": RulesJudge,
    "openai": ModelJudge,
    "gemini": ModelJudge,
    "replay": ReplayJudge,
}
