"""Extraction of the JSON object from the text of a model: without code fences, prose and thoughts."""

import json
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from tableverse_factory.core.errors import AnswerInvalidError

MAX_ANSWER_CHARS = 262_144  # maximum length of an answer, including thoughts in its text

T = TypeVar("T", bound=BaseModel)
_FENCE = "```"
_THOUGHTS = ("<think>", "</think>")


def parse_json_object(text: str) -> dict[str, Any]:
    """Parse the JSON object in a text; AnswerInvalidError if there is none, or over `MAX_ANSWER_CHARS`."""
    if len(text) > MAX_ANSWER_CHARS:
        raise AnswerInvalidError(f"the answer is longer than {MAX_ANSWER_CHARS} characters")
    answer = _strip_thoughts(text.lstrip())
    body = answer if answer.startswith("{") else _strip_fence(answer)
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
    """Validate a JSON value; the AnswerInvalidError names the first invalid place, for a round of repair."""
    try:
        return model.model_validate(value)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part)[:100] for part in first["loc"][:6])
        raise AnswerInvalidError(f"{where}: {first['msg']}"[:500]) from error


def _strip_thoughts(text: str) -> str:
    opening, closing = _THOUGHTS
    end = text.find(closing)
    return text[end + len(closing) :].lstrip() if text.startswith(opening) and end >= 0 else text


def _strip_fence(text: str) -> str:
    """Return the content of the first closed code fence, with the name of its language; else all of the text.

    By `find`, not by a pattern: the text is untrusted, and patterns with two open ends take quadratic time.
    """
    start = text.find(_FENCE)
    end = text.find(_FENCE, start + len(_FENCE))
    return text[start + len(_FENCE) : end] if 0 <= start < end else text
