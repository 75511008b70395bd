"""The door `Judge`: who answers for a scene. Real models come to this table when their backends exist."""

from collections.abc import Callable
from typing import Protocol

from schemas.config import CurateConfig
from schemas.curation import JudgeAnswer
from tableverse_factory.curate.case import Case
from tableverse_factory.curate.replay import ReplayJudge
from tableverse_factory.curate.rules import RulesJudge


class Judge(Protocol):
    """Answers in the paper's schema; ids are the indices of the case's items."""

    def answer(self, case: Case) -> JudgeAnswer:
        """The seven outputs.

        Raises:
            AnswerInvalid: if there is none, or it is beyond repair.
        """
        ...


JUDGES: dict[str, Callable[[CurateConfig], Judge]] = {
    "rules": RulesJudge,
    "replay": ReplayJudge,
}
