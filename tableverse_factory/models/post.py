"""One JSON posted, one JSON back: bounded in time and in bytes, retried where that can help, silent about the key."""

import asyncio
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any

import httpx

from schemas.address import is_loopback
from schemas.identity import content_hash
from tableverse_factory.errors import ModelAccessError, ModelError
from tableverse_factory.models.endpoint import Endpoint
from tableverse_factory.models.exchange import Request, at
from tableverse_factory.text import printable

MAX_BODY_BYTES = 4 * 1024 * 1024
"""Of an answer; reading stops there."""

_SCHEMA_WORDS = ("response_format", "responsejsonschema", "json_schema", "schema", "too many states")
_RETRIED = frozenset({408, 409, 425, 429, 500, 502, 503, 504, 520, 522, 524, 529})
_NO_KEY, _NO_CREDIT, _NO_PERMISSION, _NOT_THERE = 401, 402, 403, 404
_KEY_WORDS = frozenset({"API_KEY_INVALID", "invalid_api_key"})
_CREDIT_WORDS = frozenset({"insufficient_quota", "billing_hard_limit_reached", "billing_not_active"})
_UNSTATED = 502
"""Stands for the status of an error that came as a success and names none."""
_LONGEST_WAIT_S = 60.0


@dataclass(frozen=True, slots=True)
class _Answer:
    """An HTTP answer; `problem` says what is wrong with its transport, empty where nothing is."""

    status: int
    body: Mapping[str, Any]
    retry_after_s: float | None = None
    problem: str = ""


def post_json(endpoint: Endpoint, request: Request, headers: Mapping[str, str], deadline: float) -> Mapping[str, Any]:
    """Posts a request until it is answered.

    Args:
        endpoint: Its times and attempts.
        request: What is asked, where.
        headers: The ones with the key.
        deadline: When to give up, on `time.monotonic` [s].

    Returns:
        The JSON object of a success.

    Raises:
        ModelAccessError: if the key is refused or the credit spent: asking again is of no use.
        ModelError: if the server refuses the request, or does not answer in time.
    """
    data = json.dumps(request.body, ensure_ascii=False, allow_nan=False).encode()
    problem = "no time was left to ask"
    for attempt in range(endpoint.attempts):
        left = deadline - time.monotonic()
        if left <= 0:
            break
        answer = asyncio.run(_post(endpoint, request.url, data, headers, left))
        problem = _problem_of(answer, endpoint, headers)
        if not problem:
            return answer.body
        wait = _wait(endpoint, answer, data, attempt)
        if attempt + 1 == endpoint.attempts or wait >= deadline - time.monotonic():
            asked = f"; it asks to wait {answer.retry_after_s:.0f} s" if answer.retry_after_s else ""
            problem += f" (asked {attempt + 1} times{asked})"
            break
        time.sleep(wait)
    raise ModelError(f"{_place(request.url)}: {_without_keys(problem, headers)}")


async def _post(endpoint: Endpoint, url: str, data: bytes, headers: Mapping[str, str], left: float) -> _Answer:
    """One request; what goes wrong on the way is an answer with a problem."""
    timeout = httpx.Timeout(min(endpoint.read_s, left), connect=min(endpoint.connect_s, left))
    sent = {"Content-Type": "application/json", "Accept": "application/json", "Accept-Encoding": "identity", **headers}
    # `auth` keeps a netrc file from putting its own key in place of ours; a proxy has no business on the way home.
    options: dict[str, Any] = {"timeout": timeout, "trust_env": not is_loopback(url), "follow_redirects": False}
    try:
        async with (
            asyncio.timeout(left),
            httpx.AsyncClient(auth=_unchanged, **options) as client,
            client.stream("POST", url, content=data, headers=sent) as response,
        ):
            return await _read(response)
    except TimeoutError:
        return _Answer(0, {}, problem=f"no whole answer within {left:.0f} s")
    except httpx.TimeoutException as error:
        return _Answer(0, {}, problem=f"no answer in time ({type(error).__name__})")
    except httpx.TransportError as error:
        return _Answer(0, {}, problem=f"the connection failed: {type(error).__name__}: {printable(str(error), 200)}")


def _unchanged(request: httpx.Request) -> httpx.Request:
    return request


async def _read(response: httpx.Response) -> _Answer:
    status = response.status_code
    if response.headers.get("content-encoding", "identity") != "identity":
        return _Answer(status, {}, problem="the answer is compressed, which was not asked for")
    data = bytearray()
    async for chunk in response.aiter_raw():
        data += chunk
        if len(data) > MAX_BODY_BYTES:
            raise ModelError(f"{_place(str(response.url))}: the answer is longer than {MAX_BODY_BYTES} bytes")
    try:
        body = json.loads(bytes(data).decode("utf-8", errors="replace"))
    except (ValueError, RecursionError):
        body = None
    retry_after = _retry_after(response.headers.get("retry-after"), body)
    if isinstance(body, list):  # Gemini puts some errors into a list
        body = at(body, 0)
    if isinstance(body, Mapping):
        return _Answer(status, body, retry_after)
    return _Answer(status, {}, retry_after, "" if status >= 300 else "the answer is no whole JSON object")


def _retry_after(header: str | None, body: Any) -> float | None:
    """What the server asks to wait [s]: the header in seconds or as a date, or Gemini's RetryInfo."""
    try:
        if header is not None and header.strip().isdigit():
            return float(header)
        if header is not None:
            return max(0.0, (parsedate_to_datetime(header) - datetime.now(UTC)).total_seconds())
    except (ValueError, TypeError):
        return None
    details = at(body, "error", "details")
    for detail in details if isinstance(details, list) else []:
        delay = at(detail, "retryDelay")
        if isinstance(delay, str) and delay.removesuffix("s").replace(".", "", 1).isdigit():
            return float(delay.removesuffix("s"))
    return None


def _problem_of(answer: _Answer, endpoint: Endpoint, headers: Mapping[str, str]) -> str:
    """What is wrong and may pass; empty for a success.

    Raises:
        ModelAccessError: for what only a person can mend.
        ModelError: for what no further attempt can mend.
    """
    if answer.problem:
        return answer.problem
    status, words = answer.status, ""
    error = at(answer.body, "error") or (answer.body if at(answer.body, "object") == "error" else None)
    if 200 <= status < 300 and error is None:
        return ""
    if error is not None:
        code = at(error, "code")
        if 200 <= status < 300:
            status = code if isinstance(code, int) and 400 <= code < 600 else _UNSTATED
        words = _server_words(error, headers)
    _stop_without_access(status, error, endpoint, words)
    said = f"HTTP {status}" + (f": {words}" if words else "")
    if 300 <= status < 400:
        raise ModelError(f"{_place(endpoint.base_url)}: HTTP {status}, a redirect: refused; give the address itself")
    if status not in _RETRIED:
        about_schema = endpoint.enforce_schema and any(word in words.lower() for word in _SCHEMA_WORDS)
        hint = "; does it help to configure enforce_schema: false?" if about_schema else ""
        raise ModelError(f"{_place(endpoint.base_url)}: {said}{hint}")
    return said


def _stop_without_access(status: int, error: Any, endpoint: Endpoint, words: str) -> None:
    marks = {at(error, "code"), at(error, "type")} if isinstance(at(error, "code"), str | None) else {at(error, "type")}
    details = at(error, "details")
    marks |= {at(detail, "reason") for detail in (details if isinstance(details, list) else [])}
    named = {mark for mark in marks if isinstance(mark, str)}
    key = f"the key in {endpoint.key_env}" if endpoint.key_env else "a request without a key (configure key_env)"
    place = _place(endpoint.base_url)
    if status == _NO_KEY or named & _KEY_WORDS:
        raise ModelAccessError(f"{place} refuses {key} (HTTP {status})")
    if status == _NO_CREDIT or named & _CREDIT_WORDS:
        raise ModelAccessError(f"{place}: the credit of {key} is spent (HTTP {status})")
    if status == _NO_PERMISSION:
        raise ModelAccessError(
            f"{place}: {key} may not use {endpoint.model!r} (HTTP {status}){': ' * bool(words)}{words}"
        )

    if status == _NOT_THERE:
        said = f": {words}" if words else ""
        raise ModelAccessError(f"{place} knows no model {endpoint.model!r} at this address (HTTP {status}){said}")


def _server_words(error: Any, headers: Mapping[str, str]) -> str:
    """The server's message on one line, without anything that was sent as a key."""
    message = at(error, "message") if isinstance(error, Mapping) else error
    return printable(_without_keys(message, headers), 300) if isinstance(message, str) else ""


def _without_keys(text: str, headers: Mapping[str, str]) -> str:
    for value in headers.values():
        for secret in (value, value.rpartition(" ")[2]):
            text = text.replace(secret, "***") if secret else text
    return text


def _wait(endpoint: Endpoint, answer: _Answer, data: bytes, attempt: int) -> float:
    """Seconds before the next attempt: as the server asks, else doubling, and different for different questions."""
    if answer.retry_after_s is not None:
        return answer.retry_after_s
    spread = int(content_hash(data, bytes([attempt]))[:4], 16) / 0xFFFF
    return min(endpoint.backoff_s * 2.0**attempt, _LONGEST_WAIT_S) * (0.75 + 0.5 * spread)


def _place(url: str) -> str:
    return httpx.URL(url).netloc.decode(errors="replace")
