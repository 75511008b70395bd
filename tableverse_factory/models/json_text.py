"""The JSON object in what a model wrote: without fences, without prose around it, without its thoughts."""

import json
import re
from typing import Any

from tableverse_factory.errors import AnswerInvalidError

MAX_ANSWER_CHARS = 1_000_000

_THOUGHTS = re.compile(r"\A\s*<think>.*?</think>", re.DOTALL)
_FENCE = re.compile(r"```[A-Za-z0-9_-]*\s*\n?(.*?)```", re.DOTALL)


def json_object(text: str) -> dict[str, Any]:
    """The object.

    Raises:
        AnswerInvalidError: if there is none, or the text is longer than `MAX_ANSWER_CHARS`.
    """
    if len(text) > MAX_ANSWER_CHARS:
        raise AnswerInvalidError(f"the answer is longer than {MAX_ANSWER_CHARS} characters")
    spoken = _THOUGHTS.sub("", text)
    fenced = _FENCE.search(spoken) if not spoken.lstrip().startswith("{") else None
    body = fenced.group(1) if fenced else spoken
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
