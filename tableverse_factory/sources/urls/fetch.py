"""One picture fetched: bounded in bytes, time, redirects and attempts; what a server says of it is not believed."""

import asyncio
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from weakref import WeakValueDictionary

import httpcore
import httpx

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import pluralize, sanitize_line
from tableverse_factory.core.version import __version__
from tableverse_factory.sources.urls.addresses import CheckedNetwork, checked_url

USER_AGENT = f"tableverse-factory/{__version__}"
MAX_REDIRECTS = 5
ATTEMPTS = 3
BACKOFF_S = 1.0
MAX_CONNECT_S = 20.0
"""For a connection, all addresses of a host together [s]; half of the time for the picture, if that is less."""
_LOOKUPS = 4
"""Names that may be looked up at a time for each request: those that nobody waits for any more take their time."""
_REDIRECTS = (301, 302, 303, 307, 308)
_BUSY = (429, 500, 502, 503, 504)
_HEADERS = [(b"Accept", b"image/*"), (b"Accept-Encoding", b"identity"), (b"User-Agent", USER_AGENT.encode())]


@dataclass(frozen=True, slots=True)
class FetchBounds:
    """What fetching may cost.

    Attributes:
        max_bytes: Of one picture; reading stops there.
        timeout_s: For one picture with all redirects, attempts and waits that its server asks for, but without waiting
            for its turn [s].
        parallel: Requests under way at a time.
        per_host: Those of them to one host.
        allow_private: Whether hosts of this machine and this network may be asked.
    """

    max_bytes: int = 32_000_000
    timeout_s: float = 60.0
    parallel: int = 16
    per_host: int = 2
    allow_private: bool = False


class _BusyError(Exception):
    """A request that may succeed when it is made again; never leaves this file.

    Attributes:
        reason: Code, if it does not.
        wait_s: What the server asks to wait, or None [s].
    """

    def __init__(self, message: str, reason: str, wait_s: float | None = None) -> None:
        super().__init__(message)
        self.reason = reason
        self.wait_s = wait_s


class HostRateLimiter:
    """Whose turn it is: so many requests at a time, and fewer to one host, whatever list or redirect leads there."""

    def __init__(self, bounds: FetchBounds) -> None:
        self._all, self._per_host = asyncio.Semaphore(bounds.parallel), bounds.per_host
        self._hosts: WeakValueDictionary[bytes, asyncio.Semaphore] = WeakValueDictionary()

    @asynccontextmanager
    async def of(self, host: bytes) -> AsyncIterator[None]:
        """Holds a turn for a request to a host."""
        turn = self._hosts.setdefault(host, asyncio.Semaphore(self._per_host))
        async with turn, self._all:
            yield


@asynccontextmanager
async def connections(bounds: FetchBounds) -> AsyncIterator[httpcore.AsyncConnectionPool]:
    """A pool of checked connections; no proxy of the environment is used, for it would connect to what it likes."""
    lookups = ThreadPoolExecutor(_LOOKUPS * bounds.parallel, "lookup")
    network = CheckedNetwork(bounds.allow_private, min(MAX_CONNECT_S, bounds.timeout_s / 2.0), lookups)
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


async def fetched(pool: httpcore.AsyncConnectionPool, text: str, bounds: FetchBounds, turns: HostRateLimiter) -> bytes:
    """The bytes behind an address.

    Args:
        pool: Of connections.
        text: The address, untrusted.
        bounds: On the answer.
        turns: One is held during each request, and none while the server asks to wait.

    Raises:
        InputError: reasons `bad_url`, `private_address`, `http_error`, `too_many_redirects`, `file_too_large`,
            `too_slow`, `unreachable`, `compressed_answer`.
    """
    url, left_s = checked_url(text), bounds.timeout_s
    redirects = attempts = 0
    while redirects <= MAX_REDIRECTS:
        async with turns.of(url.raw_host):
            began = asyncio.get_running_loop().time()
            answer = await _within(pool, url, bounds, left_s)
            left_s -= asyncio.get_running_loop().time() - began
        if isinstance(answer, bytes):
            return answer
        if isinstance(answer, httpx.URL):
            url, redirects = answer, redirects + 1
            continue
        attempts += 1
        wait_s = BACKOFF_S * 2.0 ** (attempts - 1) if answer.wait_s is None else answer.wait_s
        if attempts == ATTEMPTS or wait_s >= left_s:
            asks = "" if answer.wait_s is None else f"; it asks to wait {answer.wait_s:.0f} s"
            raise InputError(f"{answer} (asked {pluralize(attempts, 'time')}{asks})", answer.reason)
        await asyncio.sleep(wait_s)
        left_s -= wait_s
    raise InputError(f"more than {MAX_REDIRECTS} redirects", "too_many_redirects")


async def _within(
    pool: httpcore.AsyncConnectionPool, url: httpx.URL, bounds: FetchBounds, left_s: float
) -> bytes | httpx.URL | _BusyError:
    """What one request gives: the body, where to ask instead, or why to ask again.

    Raises:
        InputError: see `fetched`.
    """
    try:
        async with asyncio.timeout(left_s):
            return await _asked(pool, url, bounds.max_bytes)
    except TimeoutError:
        raise InputError(f"no whole picture within {bounds.timeout_s:g} s", "too_slow") from None
    except _BusyError as error:
        return error


async def _asked(pool: httpcore.AsyncConnectionPool, url: httpx.URL, max_bytes: int) -> bytes | httpx.URL:
    target = httpcore.URL(scheme=url.raw_scheme, host=url.raw_host, port=url.port, target=url.raw_path)
    try:
        async with pool.stream("GET", target, headers=[(b"Host", url.netloc), *_HEADERS]) as answer:
            if answer.status not in _REDIRECTS:
                return await _body(answer, max_bytes)
            location = _header(answer, b"location")
    except (httpcore.NetworkError, httpcore.ProtocolError, httpcore.TimeoutException) as error:
        said = f"{type(error).__name__}: {sanitize_line(str(error))}"
        raise _BusyError(f"the connection fails: {said}", "unreachable") from error
    try:
        return checked_url(str(url.join(location)))
    except (httpx.InvalidURL, ValueError):
        raise InputError("it redirects to what is no address", "bad_url") from None
    except InputError as error:
        raise InputError(f"it redirects, and {error}", error.reason) from None


async def _body(answer: httpcore.Response, max_bytes: int) -> bytes:
    if answer.status in _BUSY:
        raise _BusyError(
            f"the server answers {answer.status}", "http_error", _retry_after(_header(answer, b"retry-after"))
        )
    if answer.status != 200:
        raise InputError(f"the server answers {answer.status}", "http_error")
    coding = _header(answer, b"content-encoding")
    if coding.lower() not in ("", "identity"):
        raise InputError(
            f"the answer is packed ({sanitize_line(coding, 20)}), which was not asked for", "compressed_answer"
        )
    length = _header(answer, b"content-length")
    too_large = InputError(f"it is longer than {max_bytes} bytes, the most that is fetched", "file_too_large")
    if length.isdecimal() and int(length[:20]) > max_bytes:
        raise too_large
    data = bytearray()
    async for chunk in answer.aiter_stream():
        data += chunk
        if len(data) > max_bytes:
            raise too_large
    return bytes(data)


def _header(answer: httpcore.Response, name: bytes) -> str:
    """The first of that name, or empty."""
    return next((value.decode("latin-1") for key, value in answer.headers if key.lower() == name), "")


def _retry_after(text: str) -> float | None:
    """What a server asks to wait, in seconds or until a date [s]."""
    try:
        if text.strip().isdecimal():
            return float(text)
        return max(0.0, (parsedate_to_datetime(text) - datetime.now(UTC)).total_seconds()) if text else None
    except (ValueError, TypeError, OverflowError):
        return None
