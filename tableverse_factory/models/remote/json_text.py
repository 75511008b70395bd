"""The JSON object in what a model wrote: without fences, without prose around it, without its thoughts."""

import json
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from tableverse_factory.core.errors import AnswerInvalidError

MAX_ANSWER_CHARS = 262_144
"""Of an answer, thoughts in its text included. A longer one is refused: what is read is also what is kept."""

T = TypeVar("T", bound=BaseModel)

_FENCE = "```"
_THOUGHTS = ("<think>", "</think>")


def json_object(text: str) -> dict[str, Any]:
    """The object.

    Raises:
        AnswerInvalidError: if there is none, or the text is longer than `MAX_ANSWER_CHARS`.
    """
    if len(text) > MAX_ANSWER_CHARS:
        raise AnswerInvalidError(f"the answer is longer than {MAX_ANSWER_CHARS} characters")
    spoken = _without_thoughts(text.lstrip())
    body = spoken if spoken.startswith("{") else _unfenced(spoken)
    start, end = body.find("{"), body.rfind("}")
    if start < 0 or end < start:
        raise AnswerInvalidError("the answer holds no JSON object")
    try:
        value = json.loads(body[start : end + 1])
    except (ValueError, RecursionError) as error:
        raise AnswerInvalidError(f"the answer is no JSON: {error}"[:300]) from error
    if not isinstance(value, dict):
        raise AnswerInvalidError("the answer is no JSON object")
    return value


def validate_answer(value: Any, model: type[T]) -> T:
    """Validate a JSON value as a structure that bounds it.

    Raises:
        AnswerInvalidError: if it does not fit; names the first place that does not, for a round of repair.
    """
    try:
        return model.model_validate(value)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part)[:100] for part in first["loc"][:6])
        raise AnswerInvalidError(f"{where}: {first['msg']}"[:500]) from error


def _without_thoughts(text: str) -> str:
    opening, closing = _THOUGHTS
    end = text.find(closing)
    return text[end + len(closing) :].lstrip() if text.startswith(opening) and end >= 0 else text


def _unfenced(text: str) -> str:
    """What stands in the first fence, after the name of its language; all of it where no fence is closed.

    By `find`, not by a pattern: the text is a stranger's, and patterns with two open ends take quadratic time.
    """
    start = text.find(_FENCE)
    end = text.find(_FENCE, start + len(_FENCE))
    return text[start + len(_FENCE) : end] if 0 <= start < end else text
