"""What a judge raises when it has no usable answer."""

from tableverse_factory.errors import ModelError


class AnswerInvalid(ModelError):  # noqa: N818
    """No answer, or one beyond repair; the scene is dropped for this reason.

    Attributes:
        reason: Code of the drop.
    """

    def __init__(self, message: str, reason: str = "judge_answer_invalid") -> None:
        super().__init__(message)
        self.reason = reason
