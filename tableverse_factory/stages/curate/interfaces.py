"""Protocol of the judges that curate a scene, and the answer that they return."""

from dataclasses import dataclass, field
from typing import Protocol

from schemas.curation import AnswerOrigin, JudgeAnswer
from tableverse_factory.stages.curate.judge_input import JudgeInput


@dataclass(frozen=True, slots=True)
class Judgement:
    """One judge's answer for one scene, before it is checked.

    Attributes:
        answer: The parsed answer.
        text: The answer as the judge wrote it; untrusted.
        origin: The model, its prompt and the rounds it took; empty for a judge that asks no model.
    """

    answer: JudgeAnswer
    text: str
    origin: AnswerOrigin = field(default_factory=AnswerOrigin)


class Judge(Protocol):
    """Answers in the paper's schema; ids are the indices of the input's objects."""

    def judge(self, case: JudgeInput) -> Judgement:
        """Give the seven outputs.

        Raises:
            AnswerInvalidError: if there is no answer, or it cannot be repaired.
            ModelError: if a model does not answer.
        """
        ...
