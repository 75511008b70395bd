"""What is wrong with an HTTP answer of a model: may it pass, must a person act, or is it of no use to ask again?"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import httpx

from tableverse_factory.core.errors import AnswerInvalidError, ModelAccessError, ModelError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.models.remote.endpoint import Endpoint
from tableverse_factory.models.remote.exchange import get_path

_SCHEMA_WORDS = ("response_format", "schema", "too many states")
_RETRIED = frozenset({408, 409, 425, 429, 500, 502, 503, 504, 520, 522, 524, 529})
_NO_KEY, _NO_CREDIT, _NO_PERMISSION, _NOT_THERE = 401, 402, 403, 404
_KEY_WORDS = frozenset({"API_KEY_INVALID", "invalid_api_key"})
_CREDIT_WORDS = frozenset({"insufficient_quota", "billing_hard_limit_reached", "billing_not_active"})
_MALFORMED = frozenset({400, 422})
"""What servers answer to a schema that they do not know, often without a word about it."""
_UNSTATED = 502
"""Stands for the status of an error that came as a success and names none."""

_CONTENT_STATUSES = frozenset({400, 403, 451, _UNSTATED})
_CONTENT_CODES = ("content_filter", "content_policy", "moderation", "sensitivecontent")
_CONTENT_WORDS = ("requires moderation", "input was flagged", "prompt was flagged", "content was flagged")
"""By which servers say that a picture or a prompt is refused, and not the key."""


@dataclass(frozen=True, slots=True)
class HttpAnswer:
    """An HTTP answer, or what came instead of one.

    Attributes:
        status: Of HTTP; 0 where there was no answer.
        body: The JSON object in it; empty where there is none.
        retry_after_s: How long the server asks to wait [s].
        problem: What is wrong with its transport; empty where nothing is.
    """

    status: int
    body: Mapping[str, Any]
    retry_after_s: float | None = None
    problem: str = ""


def problem_of(answer: HttpAnswer, endpoint: Endpoint, headers: Mapping[str, str]) -> str:
    """What is wrong and may pass; empty for a success.

    Raises:
        AnswerInvalidError: `answer_refused` if the server will not look at this picture or prompt.
        ModelAccessError: for what only a person can mend.
        ModelError: for what no further attempt can mend.
    """
    if answer.problem:
        return answer.problem
    status, words = answer.status, ""
    error = get_path(answer.body, "error") or (answer.body if get_path(answer.body, "object") == "error" else None)
    if 200 <= status < 300 and error is None:
        return ""
    if error is not None:
        code = get_path(error, "code")
        if 200 <= status < 300:
            status = code if isinstance(code, int) and 400 <= code < 600 else _UNSTATED
        words = _server_words(error, headers)
    said = f"HTTP {status}" + (f": {words}" if words else "")
    if _is_about_content(status, error, words):
        raise AnswerInvalidError(f"{place_of(endpoint.base_url)} refused the question: {said}", "answer_refused")
    _stop_without_access(status, error, endpoint, words)
    if 300 <= status < 400:
        raise ModelError(f"{place_of(endpoint.base_url)}: HTTP {status}, a redirect: refused; give the address itself")
    if status not in _RETRIED:
        key = f"{endpoint.section}.enforce_schema" if endpoint.section else "enforce_schema"
        about_schema = endpoint.dialect != "grasps" and _may_be_schema(status, words)
        hint = f"; does it help to configure {key}: false?" if about_schema and endpoint.enforce_schema else ""
        raise ModelError(f"{place_of(endpoint.base_url)}: {said}{hint}")
    return said


def _may_be_schema(status: int, words: str) -> bool:
    return status in _MALFORMED or any(word in words.lower() for word in _SCHEMA_WORDS)


def _is_about_content(status: int, error: Any, words: str) -> bool:
    """Whether what was sent is refused for what it shows: a matter of this scene, not of the key."""
    if status not in _CONTENT_STATUSES or error is None:
        return False
    is_named = any(word in code.lower() for code in _codes(error) for word in _CONTENT_CODES)
    is_said = any(word in words.lower() for word in _CONTENT_WORDS)
    return is_named or is_said or bool(get_path(error, "metadata", "reasons"))


def _stop_without_access(status: int, error: Any, endpoint: Endpoint, words: str) -> None:
    named = _codes(error)
    key = f"the key in {endpoint.key_env}" if endpoint.key_env else "a request without a key (configure key_env)"
    place, said = place_of(endpoint.base_url), f": {words}" if words else ""
    if status == _NO_KEY or named & _KEY_WORDS:
        raise ModelAccessError(f"{place} refuses {key} (HTTP {status})")
    if status == _NO_CREDIT or named & _CREDIT_WORDS:
        raise ModelAccessError(f"{place}: the credit of {key} is spent (HTTP {status})")
    if status == _NO_PERMISSION:
        raise ModelAccessError(f"{place}: {key} may not use {endpoint.model!r} (HTTP {status}){said}")
    if status == _NOT_THERE:
        raise ModelAccessError(f"{place} knows no model {endpoint.model!r} at this address (HTTP {status}){said}")


def _codes(error: Any) -> set[str]:
    """Every word by which servers name the kind of an error."""
    details = get_path(error, "details")
    reasons = [get_path(detail, "reason") for detail in (details if isinstance(details, list) else [])]
    return {word for word in (get_path(error, "code"), get_path(error, "type"), *reasons) if isinstance(word, str)}


def _server_words(error: Any, headers: Mapping[str, str]) -> str:
    """The server's message on one line, without anything that was sent as a key."""
    message = get_path(error, "message") if isinstance(error, Mapping) else error
    return sanitize_line(without_keys(message, headers), 300) if isinstance(message, str) else ""


def without_keys(text: str, headers: Mapping[str, str], least_chars: int = 1) -> str:
    """The text without the values of these headers, of those that are so long."""
    for value in headers.values():
        for secret in (value, value.rpartition(" ")[2]):
            text = text.replace(secret, "***") if len(secret) >= least_chars else text
    return text


def place_of(url: str) -> str:
    """Host and port, for messages."""
    return httpx.URL(url).netloc.decode(errors="replace")
