"""One picture fetched: bounded in bytes, time, redirects and attempts; what a server says of it is not believed."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime

import httpcore
import httpx

from tableverse_factory import __version__
from tableverse_factory.errors import InputError
from tableverse_factory.sourcing.addresses import CheckedNetwork, checked_url
from tableverse_factory.text import printable

USER_AGENT = f"tableverse-factory/{__version__}"
MAX_REDIRECTS = 5
ATTEMPTS = 3
BACKOFF_S = 1.0
_REDIRECTS = (301, 302, 303, 307, 308)
_BUSY = (429, 500, 502, 503, 504)
_HEADERS = [(b"Accept", b"image/*"), (b"Accept-Encoding", b"identity"), (b"User-Agent", USER_AGENT.encode())]


@dataclass(frozen=True, slots=True)
class FetchBounds:
    """What fetching may cost.

    Attributes:
        max_bytes: Of one picture; reading stops there.
        timeout_s: For one picture with all redirects, attempts and waits that its server asks for [s].
        parallel: Requests under way at a time.
        per_host: Those of them to one host.
        allow_private: Whether hosts of this machine and this network may be asked.
    """

    max_bytes: int = 32 * 1024 * 1024
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


@asynccontextmanager
async def connections(bounds: FetchBounds) -> AsyncIterator[httpcore.AsyncConnectionPool]:
    """A pool of checked connections; no proxy of the environment is used, for it would connect to what it likes."""
    pool = httpcore.AsyncConnectionPool(
        ssl_context=httpx.create_ssl_context(),
        max_connections=bounds.parallel,
        max_keepalive_connections=bounds.parallel,
        keepalive_expiry=5.0,
        network_backend=CheckedNetwork(bounds.allow_private),
    )
    async with pool:
        yield pool


async def fetched(
    pool: httpcore.AsyncConnectionPool, text: str, bounds: FetchBounds, turns: asyncio.Semaphore
) -> bytes:
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
    url = checked_url(text)
    left_s = bounds.timeout_s
    for attempt in range(ATTEMPTS):
        async with turns:
            began = asyncio.get_running_loop().time()
            try:
                async with asyncio.timeout(left_s):
                    return await _followed(pool, url, bounds.max_bytes)
            except TimeoutError:
                raise InputError(f"no whole picture within {bounds.timeout_s:g} s", "too_slow") from None
            except _BusyError as error:
                busy = error
            left_s -= asyncio.get_running_loop().time() - began
        wait_s = BACKOFF_S * 2.0**attempt if busy.wait_s is None else busy.wait_s
        if attempt + 1 == ATTEMPTS or wait_s >= left_s:
            break
        await asyncio.sleep(wait_s)
        left_s -= wait_s
    asks = "" if busy.wait_s is None else f"; it asks to wait {busy.wait_s:.0f} s"
    raise InputError(f"{busy} (asked {attempt + 1} times{asks})", busy.reason)


async def _followed(pool: httpcore.AsyncConnectionPool, url: httpx.URL, max_bytes: int) -> bytes:
    """The body at the end of the redirects.

    Raises:
        _BusyError: if the server is busy or the connection breaks.
        InputError: see `fetched`.
    """
    for _ in range(MAX_REDIRECTS + 1):
        target = httpcore.URL(scheme=url.raw_scheme, host=url.raw_host, port=url.port, target=url.raw_path)
        try:
            async with pool.stream("GET", target, headers=[(b"Host", url.netloc), *_HEADERS]) as answer:
                if answer.status not in _REDIRECTS:
                    return await _body(answer, max_bytes)
                location = _header(answer, b"location")
        except (httpcore.NetworkError, httpcore.ProtocolError, httpcore.TimeoutException) as error:
            said = f"{type(error).__name__}: {printable(str(error))}"
            raise _BusyError(f"the connection fails: {said}", "unreachable") from error
        try:
            url = checked_url(str(url.join(location)))
        except (httpx.InvalidURL, ValueError):
            raise InputError("it redirects to what is no address", "bad_url") from None
        except InputError as error:
            raise InputError(f"it redirects, and {error}", error.reason) from None
    raise InputError(f"more than {MAX_REDIRECTS} redirects", "too_many_redirects")


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
            f"the answer is packed ({printable(coding, 20)}), which was not asked for", "compressed_answer"
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
