"""One JSON posted, one JSON back: bounded in time and in bytes, retried where that can help, silent about the key."""

import asyncio
import json
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from typing import Any

import httpx

from schemas.address import is_loopback
from schemas.identity import content_hash
from tableverse_factory.core.errors import ModelAccessError, ModelError
from tableverse_factory.core.text import pluralize, sanitize_line
from tableverse_factory.models.remote.endpoint import Endpoint
from tableverse_factory.models.remote.exchange import HttpRequest, get_path
from tableverse_factory.models.remote.http_errors import HttpAnswer, place_of, problem_of, without_keys

MAX_BODY_BYTES = 4 * 1024 * 1024
"""Of an answer; reading stops there."""

_LONGEST_WAIT_S = 60.0
_LEAST_S = 0.001

Turn = Callable[[float], AbstractContextManager[None]]
"""Around every request: waits until it may be sent, at most until the deadline that it is given."""


def at_once(_deadline: float) -> AbstractContextManager[None]:
    """Every request may be sent."""
    return nullcontext()


def post_json(
    endpoint: Endpoint,
    request: HttpRequest,
    headers: Mapping[str, str],
    deadline: float,
    lack_of: Callable[[Mapping[str, Any]], str],
    turn: Turn = at_once,
) -> Mapping[str, Any]:
    """The JSON object of a success: posts a request until there is one, or no use in asking again.

    Args:
        endpoint: Its times and attempts.
        request: What is asked, where.
        headers: The ones with the key.
        deadline: When to give up, on `time.monotonic` [s].
        lack_of: What a success lacks that another attempt may bring; empty where nothing.
        turn: Held by each request while it is under way; waiting for it counts as waiting for the server.

    Raises:
        AnswerInvalidError: if the server refuses the question for what it shows.
        ModelAccessError: if the key is refused or the credit spent: asking again is of no use.
        ModelError: if the server refuses the request, or does not answer in time.
    """
    data = json.dumps(request.body, ensure_ascii=False, allow_nan=False).encode()
    problem = "no time was left to ask"
    for attempt in range(endpoint.attempts):
        if deadline <= time.monotonic():
            break
        with turn(deadline):
            left = max(deadline - time.monotonic(), _LEAST_S)
            answer = asyncio.run(_post(endpoint, request.url, data, headers, left))
        problem = problem_of(answer, endpoint, headers) or lack_of(answer.body)
        if not problem:
            return answer.body
        wait = _wait(endpoint, answer, data, attempt)
        if attempt + 1 == endpoint.attempts or wait >= deadline - time.monotonic():
            asked = f"; it asks to wait {answer.retry_after_s:.0f} s" if answer.retry_after_s else ""
            problem += f" (asked {pluralize(attempt + 1, 'time')}{asked})"
            break
        time.sleep(wait)
    raise ModelError(f"{place_of(request.url)}: {without_keys(problem, headers)}")


async def _post(endpoint: Endpoint, url: str, data: bytes, headers: Mapping[str, str], left: float) -> HttpAnswer:
    """One request; what goes wrong on the way is an answer with a problem."""
    sent = {"Content-Type": "application/json", "Accept": "application/json", "Accept-Encoding": "identity", **headers}
    client = _client(url, httpx.Timeout(min(endpoint.read_s, left), connect=min(endpoint.connect_s, left)))
    try:
        async with (
            asyncio.timeout(left),
            client,
            client.stream("POST", url, content=data, headers=sent) as response,
        ):
            return await _read(response)
    except TimeoutError:
        return HttpAnswer(0, {}, problem=f"no whole answer within {left:.0f} s")
    except httpx.TimeoutException as error:
        return HttpAnswer(0, {}, problem=f"no answer in time ({type(error).__name__})")
    except httpx.TransportError as error:
        said = sanitize_line(without_keys(str(error), headers), 200)  # in this order: half a key would not be found
        return HttpAnswer(0, {}, problem=f"the connection failed: {type(error).__name__}: {said}")


def _client(url: str, timeout: httpx.Timeout) -> httpx.AsyncClient:
    """A client for one request, through the proxy that the environment names.

    Raises:
        ModelAccessError: if a proxy or a file of certificates in the environment is of no use.
    """
    try:
        # `auth` keeps a netrc file from putting its own key in place of ours; a proxy has no business on the way home.
        return httpx.AsyncClient(auth=_unchanged, timeout=timeout, trust_env=not is_loopback(url))
    except (ImportError, ValueError, OSError, httpx.InvalidURL) as error:
        # Other messages than that of a missing package may quote the proxy's password.
        why = sanitize_line(str(error)) if isinstance(error, ImportError) else type(error).__name__
        names = "HTTPS_PROXY, ALL_PROXY, NO_PROXY, SSL_CERT_FILE"
        raise ModelAccessError(f"{place_of(url)} cannot be asked with what one of {names} says: {why}") from error


def _unchanged(request: httpx.Request) -> httpx.Request:
    return request


async def _read(response: httpx.Response) -> HttpAnswer:
    status = response.status_code
    if status < 300 and response.headers.get("content-encoding", "identity") != "identity":
        return HttpAnswer(status, {}, problem="the answer is compressed, which was not asked for")
    data = bytearray()
    async for chunk in response.aiter_raw():
        data += chunk
        if len(data) > MAX_BODY_BYTES:
            raise ModelError(f"{place_of(str(response.url))}: the answer is longer than {MAX_BODY_BYTES} bytes")
    try:
        body = json.loads(bytes(data).decode("utf-8", errors="replace"))
    except (ValueError, RecursionError):
        body = None
    retry_after = _retry_after(response.headers.get("retry-after"), body)
    if isinstance(body, list):  # Gemini puts some errors into a list
        body = get_path(body, 0)
    if isinstance(body, Mapping):
        return HttpAnswer(status, body, retry_after)
    return HttpAnswer(status, {}, retry_after, "" if status >= 300 else "the answer is no whole JSON object")


def _retry_after(header: str | None, body: Any) -> float | None:
    """What the server asks to wait [s]: the header in seconds or as a date, or Gemini's RetryInfo."""
    try:
        if header is not None and header.strip().isdecimal():
            return float(header)
        if header is not None:
            return max(0.0, (parsedate_to_datetime(header) - datetime.now(UTC)).total_seconds())
    except (ValueError, TypeError, OverflowError):
        return None
    details = get_path(body, "error", "details")
    for detail in details if isinstance(details, list) else []:
        delay = get_path(detail, "retryDelay")
        if isinstance(delay, str) and delay.removesuffix("s").replace(".", "", 1).isdecimal():
            return float(delay.removesuffix("s"))
    return None


def _wait(endpoint: Endpoint, answer: HttpAnswer, data: bytes, attempt: int) -> float:
    """Seconds before the next attempt: as the server asks, else doubling, and different for different questions."""
    if answer.retry_after_s is not None:
        return answer.retry_after_s
    spread = int(content_hash(data, bytes([attempt]))[:4], 16) / 0xFFFF
    return min(endpoint.backoff_s * 2.0**attempt, _LONGEST_WAIT_S) * (0.75 + 0.5 * spread)
