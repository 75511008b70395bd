"""Classification of HTTP errors: transient, for a person to resolve, or final."""

from collections.abc import Mapping
from typing import Any

import httpx

from tableverse_factory.core.errors import AnswerInvalidError, ModelAccessError, ModelError
from tableverse_factory.core.retry import TRANSIENT_STATUSES, TransientError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.models.remote.endpoint import Endpoint
from tableverse_factory.models.remote.exchange import get_path

_SCHEMA_WORDS = ("response_format", "schema", "too many states")
_TRANSIENT = TRANSIENT_STATUSES | {409, 520, 522, 524, 529}
_NO_KEY, _NO_CREDIT, _NO_PERMISSION, _NOT_THERE = 401, 402, 403, 404
_KEY_WORDS = frozenset({"API_KEY_INVALID", "invalid_api_key"})
_CREDIT_WORDS = frozenset({"insufficient_quota", "billing_hard_limit_reached", "billing_not_active"})
_MALFORMED = frozenset({400, 422})  # statuses of a request with an unknown schema, often without a message about it
_UNSTATED = 502  # stands for the status of an error that came with a status of success

# Marks of an error about a picture or a prompt, as opposed to the key.
_CONTENT_STATUSES = frozenset({400, 403, 451, _UNSTATED})
_CONTENT_CODES = ("content_filter", "content_policy", "moderation", "sensitivecontent")
_CONTENT_WORDS = ("requires moderation", "input was flagged", "prompt was flagged", "content was flagged")


def raise_for_answer(
    status: int, body: Mapping[str, Any], endpoint: Endpoint, headers: Mapping[str, str], wait_s: float | None
) -> None:
    """Return for a success, and raise for everything else.

    The JSON `body` is untrusted, and empty without one; `wait_s` is what the server asks for [s]; messages must not
    contain the key, which is in the headers.

    Raises:
        TransientError: if another attempt may succeed.
        AnswerInvalidError: `answer_refused` if the server refuses this picture or prompt.
        ModelAccessError: if a person must act.
        ModelError: if no further attempt can succeed.
    """
    message = ""
    error = get_path(body, "error") or (body if get_path(body, "object") == "error" else None)
    if 200 <= status < 300 and error is None:
        return
    if error is not None:
        code = get_path(error, "code")
        if 200 <= status < 300:
            status = code if isinstance(code, int) and 400 <= code < 600 else _UNSTATED
        message = _read_message(error, headers)
    host, text = format_host(endpoint.base_url), f"HTTP {status}" + (f": {message}" if message else "")
    if _is_about_content(status, error, message):
        raise AnswerInvalidError(f"{host} refused the question: {text}", "answer_refused")
    _raise_without_access(status, error, endpoint, message)
    if 300 <= status < 400:
        raise ModelError(f"{host}: HTTP {status}, a redirect: redirects are not followed; configure the final address")
    if status in _TRANSIENT:
        raise TransientError(text, wait_s)
    key = f"{endpoint.section}.enforce_schema" if endpoint.section else "enforce_schema"
    about_schema = status in _MALFORMED or any(word in message.lower() for word in _SCHEMA_WORDS)
    enforced = endpoint.dialect in ("openai", "gemini") and endpoint.enforce_schema
    hint = f"; does it help to configure {key}: false?" if about_schema and enforced else ""
    raise ModelError(f"{host}: {text}{hint}")


def _is_about_content(status: int, error: Any, message: str) -> bool:
    """Whether the picture or prompt is refused: a matter of this scene, not of the key."""
    if status not in _CONTENT_STATUSES or error is None:
        return False
    has_code = any(word in code.lower() for code in _read_codes(error) for word in _CONTENT_CODES)
    has_words = any(word in message.lower() for word in _CONTENT_WORDS)
    return has_code or has_words or bool(get_path(error, "metadata", "reasons"))


def _raise_without_access(status: int, error: Any, endpoint: Endpoint, message: str) -> None:
    codes = _read_codes(error)
    key = f"the key in {endpoint.key_env}" if endpoint.key_env else "a request without a key (configure key_env)"
    host, suffix = format_host(endpoint.base_url), f": {message}" if message else ""
    if status == _NO_KEY or codes & _KEY_WORDS:
        raise ModelAccessError(f"{host} refuses {key} (HTTP {status})")
    if status == _NO_CREDIT or codes & _CREDIT_WORDS:
        raise ModelAccessError(f"{host}: the credit of {key} is spent (HTTP {status})")
    if status == _NO_PERMISSION:
        raise ModelAccessError(f"{host}: {key} may not use {endpoint.model!r} (HTTP {status}){suffix}")
    if status == _NOT_THERE:
        raise ModelAccessError(f"{host} knows no model {endpoint.model!r} at this address (HTTP {status}){suffix}")


def _read_codes(error: Any) -> set[str]:
    details = get_path(error, "details")
    reasons = [get_path(detail, "reason") for detail in (details if isinstance(details, list) else [])]
    return {word for word in (get_path(error, "code"), get_path(error, "type"), *reasons) if isinstance(word, str)}


def _read_message(error: Any, headers: Mapping[str, str]) -> str:
    """Return the server's message on one line, without keys."""
    message = get_path(error, "message") if isinstance(error, Mapping) else error
    return sanitize_line(redact_keys(message, headers), 300) if isinstance(message, str) else ""


def redact_keys(text: str, headers: Mapping[str, str], min_chars: int = 1) -> str:
    """Replace the values of headers, of at least `min_chars` characters, by `***`."""
    for value in headers.values():
        for secret in (value, value.rpartition(" ")[2]):
            text = text.replace(secret, "***") if len(secret) >= min_chars else text
    return text


def format_host(url: str) -> str:
    """Return host and port, for messages."""
    return httpx.URL(url).netloc.decode(errors="replace")
