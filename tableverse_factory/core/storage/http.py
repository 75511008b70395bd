"""Byte ranges of files behind HTTP: bounded, retried, and checked against what was requested."""

import itertools
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from urllib.request import getproxies

import httpx

from schemas.address import is_loopback
from tableverse_factory.core.errors import StoreError
from tableverse_factory.core.retry import TRANSIENT_STATUSES, RetryPolicy, TransientError, parse_retry_after
from tableverse_factory.core.storage.files import redact_uri
from tableverse_factory.core.storage.http_redirects import MAX_REDIRECTS, check_peer, is_same_origin, resolve_redirect
from tableverse_factory.core.text import pluralize, sanitize_line

RETRY_POLICY = RetryPolicy(attempts=5, backoff_s=0.5, max_asked_s=60.0)

_TIMEOUTS = httpx.Timeout(30.0, connect=10.0)
_SLOWEST_BYTES_PER_S = 20_000
_PROXY_SCHEMES = frozenset({"http", "https", "all"})
_RANGE = re.compile(r"bytes (\d{1,18})-(\d{1,18})/(\d{1,18})")
_PAST_THE_END = re.compile(r"bytes \*/(\d{1,18})")


@dataclass(frozen=True, slots=True)
class ByteRange:
    """Bytes, fewer where the file ends earlier, its whole length, and its ETag or Last-Modified or nothing."""

    data: bytes
    total: int
    version: str


class RefusedError(StoreError):
    """The server refuses to serve a file (401, 403), which may mean that there is none."""


class HttpRangeReader:
    """Reader of byte ranges with one connection pool per process; safe in threads and after a fork."""

    def __init__(self, headers: Callable[[], Mapping[str, str]] = dict) -> None:
        """Open nothing yet; `headers` gives further headers, such as a token, for the named host alone."""
        self._headers = headers
        self._clients: dict[int, httpx.Client] = {}
        self._by_proxy = False

    def read(self, address: str, start: int, stop: int) -> ByteRange:
        """Read the bytes from `start` to before `stop`; an interrupted answer is resumed where it broke off.

        Raises:
            FileNotFoundError: if there is no such file.
            StoreError: if the server refuses, fails five times, serves no ranges, or sends another range.
        """
        data, seen = bytearray(), list[tuple[int, str]]()

        def resume() -> ByteRange:
            with self._request(address, start + len(data), stop) as response:
                total = _check_range(response, start + len(data), stop, address)
                seen.append((total, _read_version(response)))
                if seen[0] != seen[-1]:
                    raise _error(address, "it changed while it was read: open the dataset again")
                _receive(response, data, max(0, min(stop, total) - start), address)
            return ByteRange(bytes(data), *seen[0])

        return _retry(address, resume)

    def read_size(self, address: str) -> ByteRange:
        """Read length and version of a file, and none of its bytes."""

        def ask() -> ByteRange:
            with self._request(address, 0, 1) as response:
                length = response.headers.get("content-length", "")
                if response.status_code == 200 and length.isdecimal():  # it says so; reading it may be refused later
                    return ByteRange(b"", int(length), _read_version(response))
                return ByteRange(b"", _check_range(response, 0, 1, address), _read_version(response))

        return _retry(address, ask)

    @contextmanager
    def _request(self, address: str, start: int, stop: int) -> Iterator[httpx.Response]:
        headers = {"Range": f"bytes={start}-{stop - 1}", "Accept-Encoding": "identity"}
        target, first_peer, client = address, "", self._client(address)
        for _ in range(MAX_REDIRECTS + 1):
            own = self._headers() if is_same_origin(target, address) else {}
            with client.stream("GET", target, headers={**headers, **own}) as response:
                peer = self._peer(response)
                first_peer = first_peer or peer
                if peer:
                    check_peer(address, target, first_peer, peer)
                if not response.has_redirect_location:
                    _check_status(response, address)
                    yield response
                    return
                target = resolve_redirect(address, target, response.headers["location"])
        raise _error(address, f"more than {MAX_REDIRECTS} redirects")

    def _peer(self, response: httpx.Response) -> str:
        """Get the IP address that answered; empty behind a proxy, which resolves names itself."""
        try:
            return "" if self._by_proxy else str(response.extensions["network_stream"].get_extra_info("server_addr")[0])
        except OSError as error:
            raise TransientError(f"the connection broke ({type(error).__name__})") from None

    def _client(self, address: str) -> httpx.Client:
        """Get the client of this process: a forked child must not read from its parent's connections."""
        process = os.getpid()
        if process not in self._clients:
            self._by_proxy = not is_loopback(address) and bool(_PROXY_SCHEMES.intersection(getproxies()))
            try:
                self._clients = {process: httpx.Client(timeout=_TIMEOUTS, trust_env=not is_loopback(address))}
            except (ImportError, ValueError, OSError, httpx.InvalidURL) as error:
                names = "HTTPS_PROXY, ALL_PROXY, NO_PROXY, SSL_CERT_FILE"
                why = type(error).__name__  # its message may hold the password of a proxy
                raise StoreError(
                    f"{redact_uri(address)} cannot be asked with what one of {names} says: {why}"
                ) from None
        return self._clients[process]


def _retry(address: str, ask: Callable[[], ByteRange]) -> ByteRange:
    for attempt in itertools.count(1):
        try:
            return ask()
        except (TransientError, httpx.TransportError) as error:
            asked_s = error.wait_s if isinstance(error, TransientError) else None
            wait_s = RETRY_POLICY.next_wait(attempt, asked_s)
            if wait_s is None:
                raise _error(address, f"{_describe(error)} (asked {pluralize(attempt, 'time')})") from None
        time.sleep(wait_s)
    raise AssertionError("the last attempt returns or raises")


def _check_status(response: httpx.Response, address: str) -> None:
    status = response.status_code
    if status in (200, 206, 416):
        return
    if status in (404, 410):
        raise FileNotFoundError(f"{redact_uri(address)}: there is no such file")
    if status in (401, 403):
        raise RefusedError(
            f"{redact_uri(address)}: the server refuses ({status}): it is private, the token is wrong, or, in a bucket "
            "that may not be listed, there is no such file"
        )
    if status in TRANSIENT_STATUSES:
        raise TransientError(f"the server answers {status}", parse_retry_after(response.headers.get("retry-after")))
    raise _error(address, f"the server answers {status}")


def _check_range(response: httpx.Response, start: int, stop: int, address: str) -> int:
    """Check that the answer is the requested range; returns the length of the whole file [bytes]."""
    if response.headers.get("content-encoding", "identity") != "identity":
        raise _error(address, "the server compresses ranges: it must send files as they are")
    header = response.headers.get("content-range", "").strip()
    if response.status_code == 416:
        end = _PAST_THE_END.fullmatch(header)
        if end is None or int(end[1]) > start:
            raise _error(address, f"the server refuses bytes {start} to {stop}")
        return int(end[1])
    if response.status_code == 200:
        length = response.headers.get("content-length", "")
        if start == 0 and length.isdecimal() and int(length) <= stop:
            return int(length)  # all of a small file
        remedy = "put the dataset behind one that does, such as nginx, S3 or the Hub"
        raise _error(address, f"the server does not serve ranges of bytes: {remedy}")
    found = _RANGE.fullmatch(header)
    if found is None or (int(found[1]), int(found[2])) != (start, min(stop, int(found[3])) - 1):
        given = sanitize_line(header, 80) or "no Content-Range"
        raise _error(address, f"asked for bytes {start} to {stop - 1}, the server gives {given}")
    return int(found[3])


def _read_version(response: httpx.Response) -> str:
    return str(response.headers.get("etag") or response.headers.get("last-modified") or "")


def _receive(response: httpx.Response, data: bytearray, wanted: int, address: str) -> None:
    if response.status_code == 416:
        return
    deadline = time.monotonic() + 60.0 + (wanted - len(data)) / _SLOWEST_BYTES_PER_S
    for chunk in response.iter_raw():
        data += chunk
        if len(data) > wanted:
            raise _error(address, "the answer is longer than it says")
        if time.monotonic() > deadline:
            raise TransientError("the answer takes too long")
    if len(data) < wanted:
        raise TransientError(f"the answer is cut short, {wanted - len(data)} bytes are missing")


def _describe(error: Exception) -> str:
    if isinstance(error, TransientError):
        return f"{error}, and asks to wait {error.wait_s:.0f} s" if error.wait_s else str(error)
    return f"no answer ({type(error).__name__}: {sanitize_line(str(error), 200)})"


def _error(address: str, problem: str) -> StoreError:
    return StoreError(f"{redact_uri(address)}: {problem}")
