"""What a judge hands in: its answer in the paper's schema, its own words, and where they come from."""

from dataclasses import dataclass, field

from schemas.curation import AnswerOrigin, JudgeAnswer


@dataclass(frozen=True, slots=True)
class Judgement:
    """One judge's answer for one scene, before the checks.

    Attributes:
        answer: As it was read.
        text: As it was given; untrusted.
        origin: The model and what it cost.
    """

    answer: JudgeAnswer
    text: str
    origin: AnswerOrigin = field(default_factory=AnswerOrigin)
