"""HTTP requests to models and services: bounded in time and bytes, retried by one policy, silent about the key."""

import asyncio
import itertools
import json
import ssl
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar

import httpx

from schemas.address import is_loopback
from schemas.identity import content_hash
from tableverse_factory.core.errors import ModelAccessError, ModelError
from tableverse_factory.core.retry import RetryPolicy, TransientError, parse_retry_after
from tableverse_factory.core.text import pluralize, sanitize_line
from tableverse_factory.models.remote.endpoint import Endpoint
from tableverse_factory.models.remote.exchange import get_path
from tableverse_factory.models.remote.http_errors import format_host, raise_for_answer, redact_keys

_LEAST_S = 0.001
# Headers taken over from the caller: client libraries add others, some of them from the environment.
_SENT_HEADERS = ("host", "content-type", "content-length", "user-agent")

# Context of every request: waits until it may be sent, at most until the deadline that it is given.
Turn = Callable[[float], AbstractContextManager[None]]

T = TypeVar("T")


def send_at_once(_deadline: float) -> AbstractContextManager[None]:
    """Let every request be sent without waiting."""
    return nullcontext()


def choose_authorities(url: str) -> ssl.SSLContext | bool:
    """Choose whom to trust: True for the usual authorities; for http nobody, which saves 25 ms of reading them."""
    return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT) if httpx.URL(url).scheme == "http" else True


class BoundedClient(httpx.AsyncClient):
    """HTTP client for one request to one endpoint; every answer that it returns is a success with a JSON object.

    It is handed to client libraries in place of their own: the key, proxies, redirects, timeouts and the size of
    answers are decided here, and all failures are raised as errors of this package or as `TransientError`.
    """

    def __init__(self, endpoint: Endpoint, left_s: float, headers: Mapping[str, str]) -> None:
        """Open a client with `left_s` [s] for the request and the key in its headers.

        Raises:
            ModelAccessError: if the environment names an unusable proxy or certificate file.
        """
        self._endpoint, self._key_headers = endpoint, headers
        timeout = httpx.Timeout(min(endpoint.read_s, left_s), connect=min(endpoint.connect_s, left_s))
        try:
            # `auth` keeps a netrc file from replacing our key; loopback addresses bypass proxies.
            super().__init__(
                auth=lambda request: request,
                timeout=timeout,
                trust_env=not is_loopback(endpoint.base_url),
                verify=choose_authorities(endpoint.base_url),
            )
        except (ImportError, ValueError, OSError, httpx.InvalidURL) as error:
            # Messages other than that of a missing package may quote the proxy's password.
            why = sanitize_line(str(error)) if isinstance(error, ImportError) else type(error).__name__
            raise ModelAccessError(
                f"{format_host(endpoint.base_url)} cannot be reached with the settings in one of HTTPS_PROXY, "
                f"ALL_PROXY, NO_PROXY, SSL_CERT_FILE: {why}"
            ) from error

    async def send(self, request: httpx.Request, **_options: Any) -> httpx.Response:
        """Send a request and read its whole answer; raises as `raise_for_answer`."""
        host, own = request.url.netloc, httpx.URL(self._endpoint.base_url).netloc
        if host != own:
            raise ModelError(f"a request for {own.decode()} was addressed to {host.decode()}; it was not sent")
        kept = {name: request.headers[name] for name in _SENT_HEADERS if name in request.headers}
        fixed = {"Accept": "application/json", "Accept-Encoding": "identity"}
        request.headers = httpx.Headers({**kept, **fixed, **self._key_headers})
        try:
            response = await super().send(request, stream=True, follow_redirects=False)
            try:
                return await self._read(response)
            finally:
                await response.aclose()
        except httpx.TimeoutException as error:
            raise TransientError(f"no answer in time ({type(error).__name__})") from error
        except httpx.TransportError as error:
            # Keys first: half of one that was cut off would not be found.
            message = sanitize_line(redact_keys(str(error), self._key_headers), 200)
            raise TransientError(f"the connection failed: {type(error).__name__}: {message}") from error

    async def _read(self, response: httpx.Response) -> httpx.Response:
        is_success = response.status_code < 300
        if is_success and response.headers.get("content-encoding", "identity") != "identity":
            raise TransientError("the answer is compressed, which was not asked for")
        data, most = bytearray(), self._endpoint.max_body_bytes
        async for chunk in response.aiter_raw():
            data += chunk
            if len(data) > most:
                raise ModelError(f"{format_host(self._endpoint.base_url)}: the answer is longer than {most} bytes")
        body = _parse_json(data)
        header = response.headers.get("retry-after")
        wait_s = _find_retry_delay(body) if header is None else parse_retry_after(header)
        if isinstance(body, list):  # Gemini puts some errors into a list
            body = get_path(body, 0)
        if is_success and not isinstance(body, Mapping):
            raise TransientError("the answer is no whole JSON object", wait_s)
        status, found = response.status_code, body if isinstance(body, Mapping) else {}
        raise_for_answer(status, found, self._endpoint, self._key_headers, wait_s)
        kind, content = {"Content-Type": "application/json"}, json.dumps(body).encode()
        return httpx.Response(status, headers=kind, content=content, request=response.request)


def send_with_retries(
    endpoint: Endpoint,
    send: Callable[[BoundedClient], Awaitable[T]],
    headers: Mapping[str, str],
    deadline: float,
    turn: Turn = send_at_once,
    seed: bytes = b"",
) -> T:
    """Send a request until it succeeds or another attempt is of no use.

    Args:
        endpoint: Address, times and attempts.
        send: Sends the request with the client that it is given; raises `TransientError` to be called again.
        headers: Headers with the key.
        deadline: When to give up, on `time.monotonic` [s].
        turn: Held while a request is under way; waiting for it counts as waiting for the server.
        seed: Spreads the waits of different requests.

    Raises:
        AnswerInvalidError: if the server refuses the question for its content.
        ModelAccessError: if the key is refused or the credit is spent.
        ModelError: if the server refuses the request, or does not answer in time.
    """
    policy = RetryPolicy(endpoint.attempts, endpoint.backoff_s)
    for attempt in itertools.count(1):
        if deadline <= time.monotonic():
            raise ModelError(f"{format_host(endpoint.base_url)}: no time was left to ask")
        try:
            with turn(deadline):
                left_s = max(deadline - time.monotonic(), _LEAST_S)
                return asyncio.run(_send_once(endpoint, send, headers, left_s))
        except TransientError as error:
            jitter = 0.75 + 0.5 * int(content_hash(seed, bytes([attempt - 1]))[:4], 16) / 0xFFFF
            wait_s = policy.next_wait(attempt, error.wait_s, deadline - time.monotonic(), jitter)
            if wait_s is None:
                asked = f"; it asks to wait {error.wait_s:.0f} s" if error.wait_s else ""
                problem = f"{redact_keys(str(error), headers)} (asked {pluralize(attempt, 'time')}{asked})"
                raise ModelError(f"{format_host(endpoint.base_url)}: {problem}") from None
        time.sleep(wait_s)
    raise AssertionError("the attempts are counted without end")


def post_json(endpoint: Endpoint, path: str, body: Mapping[str, Any]) -> Mapping[str, Any]:
    """Post a JSON object to a path below the endpoint's address and return that of its answer (`send_with_retries`)."""
    url = f"{endpoint.base_url.rstrip('/')}/{path}"

    async def send(client: BoundedClient) -> Mapping[str, Any]:
        return (await client.post(url, json=body)).json()

    return send_with_retries(endpoint, send, {}, time.monotonic() + endpoint.timeout_s, seed=url.encode())


async def _send_once(
    endpoint: Endpoint, send: Callable[[BoundedClient], Awaitable[T]], headers: Mapping[str, str], left_s: float
) -> T:
    try:
        async with asyncio.timeout(left_s), BoundedClient(endpoint, left_s, headers) as client:
            return await send(client)
    except TimeoutError:
        raise TransientError(f"no whole answer within {left_s:.0f} s") from None


def _parse_json(data: bytes | bytearray) -> Any:
    try:
        return json.loads(data.decode("utf-8", errors="replace"))
    except (ValueError, RecursionError):
        return None


def _find_retry_delay(body: Any) -> float | None:
    """Read Gemini's RetryInfo from the body of an error [s]."""
    details = get_path(body, "error", "details")
    for detail in details if isinstance(details, list) else []:
        delay = get_path(detail, "retryDelay")
        if isinstance(delay, str) and delay.removesuffix("s").replace(".", "", 1).isdecimal():
            return float(delay.removesuffix("s"))
    return None
