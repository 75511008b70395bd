"""Protocol of the judges that curate a scene, and the answer that they return."""

from dataclasses import dataclass, field
from typing import Protocol

from schemas.curation import AnswerOrigin, JudgeAnswer
from tableverse_factory.stages.curate.judge_input import JudgeInput


@dataclass(frozen=True, slots=True)
class Judgement:
    """One judge's answer for one scene, before it is checked; `text` is as the judge wrote it, untrusted."""

    answer: JudgeAnswer
    text: str
    origin: AnswerOrigin = field(default_factory=AnswerOrigin)


class Judge(Protocol):
    """Answers in the paper's schema; ids are the indices of the input's objects."""

    def judge(self, case: JudgeInput) -> Judgement:
        """Give the seven outputs; AnswerInvalidError if there is no answer, or it cannot be repaired."""
        ...
