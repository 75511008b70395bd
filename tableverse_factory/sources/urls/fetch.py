"""Fetching of one file: bounded in bytes, time, redirects and attempts; no header of the server is trusted."""

import asyncio
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass
from weakref import WeakValueDictionary

import httpcore
import httpx

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.retry import TRANSIENT_STATUSES, RetryPolicy, TransientError, parse_retry_after
from tableverse_factory.core.text import pluralize, sanitize_line
from tableverse_factory.core.version import __version__
from tableverse_factory.sources.urls.addresses import CheckedNetworkBackend, parse_url

USER_AGENT = f"tableverse-factory/{__version__}"
MAX_REDIRECTS = 5
RETRY_POLICY = RetryPolicy(attempts=3, backoff_s=1.0)
MAX_CONNECT_S = 20.0  # For a connection, over all addresses of a host [s]; at most half of the time for the picture
_LOOKUPS = 4  # DNS look-ups at a time for each request; abandoned ones still occupy a thread
_REDIRECTS = (301, 302, 303, 307, 308)
_HEADERS = [(b"Accept", b"image/*"), (b"Accept-Encoding", b"identity"), (b"User-Agent", USER_AGENT.encode())]


@dataclass(frozen=True, slots=True)
class FetchBounds:
    """Bounds on fetching.

    Attributes:
        max_bytes: Of one picture; reading stops there.
        timeout_s: For one picture with all redirects, attempts and waits, but without waiting for its turn [s].
        allow_private: Whether addresses of this machine and its network are allowed.
    """

    max_bytes: int = 32_000_000
    timeout_s: float = 60.0
    parallel: int = 16
    per_host: int = 2
    allow_private: bool = False


class _BusyError(TransientError):
    """A request that may succeed when it is repeated; `reason` is the code if it does not."""

    def __init__(self, message: str, reason: str, wait_s: float | None = None) -> None:
        super().__init__(message, wait_s)
        self.reason = reason


class HostRateLimiter:
    """Bound on concurrent requests, in all and to one host, across lists and redirects."""

    def __init__(self, bounds: FetchBounds) -> None:
        self._all, self._per_host = asyncio.Semaphore(bounds.parallel), bounds.per_host
        self._hosts: WeakValueDictionary[bytes, asyncio.Semaphore] = WeakValueDictionary()

    @asynccontextmanager
    async def acquire(self, host: bytes) -> AsyncIterator[None]:
        """Hold a slot for a request to a host."""
        turn = self._hosts.setdefault(host, asyncio.Semaphore(self._per_host))
        async with turn, self._all:
            yield


@asynccontextmanager
async def open_connections(bounds: FetchBounds) -> AsyncIterator[httpcore.AsyncConnectionPool]:
    """Open a pool of checked connections; proxies of the environment are ignored, as they choose the address."""
    lookups = ThreadPoolExecutor(_LOOKUPS * bounds.parallel, "lookup")
    network = CheckedNetworkBackend(bounds.allow_private, min(MAX_CONNECT_S, bounds.timeout_s / 2.0), lookups)
    pool = httpcore.AsyncConnectionPool(
        ssl_context=httpx.create_ssl_context(),
        max_connections=bounds.parallel,
        max_keepalive_connections=bounds.parallel,
        keepalive_expiry=5.0,
        network_backend=network,
    )
    try:
        async with pool:
            yield pool
    finally:
        lookups.shutdown(wait=False, cancel_futures=True)


async def fetch_bytes(
    pool: httpcore.AsyncConnectionPool, text: str, bounds: FetchBounds, turns: HostRateLimiter
) -> bytes:
    """Fetch the bytes behind an untrusted address; waits between attempts hold no slot of `turns`.

    Raises:
        InputError: reasons `bad_url`, `private_address`, `http_error`, `too_many_redirects`, `file_too_large`,
            `too_slow`, `unreachable`, `compressed_answer`.
    """
    url, left_s = parse_url(text), bounds.timeout_s
    redirects = attempts = 0
    while redirects <= MAX_REDIRECTS:
        async with turns.acquire(url.raw_host):
            began = asyncio.get_running_loop().time()
            answer = await _try_request(pool, url, bounds, left_s)
            left_s -= asyncio.get_running_loop().time() - began
        if isinstance(answer, bytes):
            return answer
        if isinstance(answer, httpx.URL):
            url, redirects = answer, redirects + 1
            continue
        attempts += 1
        wait_s = RETRY_POLICY.next_wait(attempts, answer.wait_s, left_s)
        if wait_s is None:
            asks = "" if answer.wait_s is None else f"; it asks to wait {answer.wait_s:.0f} s"
            raise InputError(f"{answer} (asked {pluralize(attempts, 'time')}{asks})", answer.reason)
        await asyncio.sleep(wait_s)
        left_s -= wait_s
    raise InputError(f"more than {MAX_REDIRECTS} redirects", "too_many_redirects")


async def _try_request(
    pool: httpcore.AsyncConnectionPool, url: httpx.URL, bounds: FetchBounds, left_s: float
) -> bytes | httpx.URL | _BusyError:
    """Make one request; returns the body, the address of a redirect, or why to try again."""
    try:
        async with asyncio.timeout(left_s):
            return await _request(pool, url, bounds.max_bytes)
    except TimeoutError:
        raise InputError(f"no whole picture within {bounds.timeout_s:g} s", "too_slow") from None
    except _BusyError as error:
        return error


async def _request(pool: httpcore.AsyncConnectionPool, url: httpx.URL, max_bytes: int) -> bytes | httpx.URL:
    target = httpcore.URL(scheme=url.raw_scheme, host=url.raw_host, port=url.port, target=url.raw_path)
    try:
        async with pool.stream("GET", target, headers=[(b"Host", url.netloc), *_HEADERS]) as answer:
            if answer.status not in _REDIRECTS:
                return await _read_body(answer, max_bytes)
            location = _get_header(answer, b"location")
    except (httpcore.NetworkError, httpcore.ProtocolError, httpcore.TimeoutException) as error:
        detail = f"{type(error).__name__}: {sanitize_line(str(error))}"
        raise _BusyError(f"the connection fails: {detail}", "unreachable") from error
    try:
        return parse_url(str(url.join(location)))
    except (httpx.InvalidURL, ValueError):
        raise InputError("it redirects to what is no address", "bad_url") from None
    except InputError as error:
        raise InputError(f"it redirects, and {error}", error.reason) from None


async def _read_body(answer: httpcore.Response, max_bytes: int) -> bytes:
    if answer.status in TRANSIENT_STATUSES:
        wait_s = parse_retry_after(_get_header(answer, b"retry-after"))
        raise _BusyError(f"the server answers {answer.status}", "http_error", wait_s)
    if answer.status != 200:
        raise InputError(f"the server answers {answer.status}", "http_error")
    coding = _get_header(answer, b"content-encoding")
    if coding.lower() not in ("", "identity"):
        problem = f"the answer is packed ({sanitize_line(coding, 20)}), which was not asked for"
        raise InputError(problem, "compressed_answer")
    length = _get_header(answer, b"content-length")
    too_large = InputError(f"it is longer than {max_bytes} bytes, the most that is fetched", "file_too_large")
    if length.isdecimal() and int(length[:20]) > max_bytes:
        raise too_large
    data = bytearray()
    async for chunk in answer.aiter_stream():
        data += chunk
        if len(data) > max_bytes:
            raise too_large
    return bytes(data)


def _get_header(answer: httpcore.Response, name: bytes) -> str:
    return next((value.decode("latin-1") for key, value in answer.headers if key.lower() == name), "")
