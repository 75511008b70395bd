"""Bytes of files behind HTTP, asked for by range: bounded, retried, and checked whatever a server answers."""

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
from tableverse_factory.core.storage.files import redact_uri
from tableverse_factory.core.storage.http_redirects import MAX_REDIRECTS, check_peer, next_address, same_host
from tableverse_factory.core.text import pluralize, sanitize_line

ATTEMPTS = 5
BACKOFF_S = 0.5
"""Before the second attempt [s]; it doubles."""

_LONGEST_WAIT_S = 60.0
_TIMES = httpx.Timeout(30.0, connect=10.0)
_SLOWEST_BYTES_PER_S = 20_000
_PASSES = frozenset({408, 425, 429, 500, 502, 503, 504})
_PROXIES = frozenset({"http", "https", "all"})
_RANGE = re.compile(r"bytes (\d{1,18})-(\d{1,18})/(\d{1,18})")
_PAST_THE_END = re.compile(r"bytes \*/(\d{1,18})")


@dataclass(frozen=True, slots=True)
class Piece:
    """Some bytes of a file.

    Attributes:
        data: Fewer than were asked for where the file ends before.
        total: Length of the whole file [bytes].
        version: What the server calls this version of it (ETag or Last-Modified); empty where it says neither.
    """

    data: bytes
    total: int
    version: str


class RefusedError(StoreError):
    """The server does not let us read a file (401, 403), or does not tell that there is none."""


class _PassingError(Exception):
    """What another attempt may heal; `wait_s` is what the server asks for."""

    def __init__(self, problem: str, wait_s: float | None = None) -> None:
        super().__init__(problem)
        self.wait_s = wait_s


def _no_headers() -> Mapping[str, str]:
    return {}


class Ranges:
    """Reads ranges with one pool of connections; may be used in many threads, and goes on after a fork."""

    def __init__(self, headers: Callable[[], Mapping[str, str]] = _no_headers) -> None:
        """Opens nothing yet.

        Args:
            headers: What the host that was named is told besides, such as a token; no other host is.
        """
        self._headers = headers
        self._clients: dict[int, httpx.Client] = {}
        self._by_proxy = False

    def read(self, address: str, start: int, stop: int) -> Piece:
        """The bytes from `start` to before `stop`; an answer that breaks off is gone on with where it broke.

        Raises:
            FileNotFoundError: if there is no such file.
            StoreError: if the server refuses, fails five times, serves no ranges, or gives what was not asked for.
        """
        data, seen = bytearray(), list[tuple[int, str]]()

        def go_on() -> Piece:
            with self._asked(address, start + len(data), stop) as response:
                total = _total(response, start + len(data), stop, address)
                seen.append((total, _version(response)))
                if seen[0] != seen[-1]:
                    raise StoreError(f"{redact_uri(address)}: it changed while it was read: open the dataset again")
                _receive(response, data, max(0, min(stop, total) - start), address)
            return Piece(bytes(data), *seen[0])

        return _again(address, go_on)

    def size(self, address: str) -> Piece:
        """Length and version of a file, without any of its bytes.

        Raises:
            FileNotFoundError: if there is no such file.
            StoreError: if the server refuses, fails five times, or does not say.
        """

        def ask() -> Piece:
            with self._asked(address, 0, 1) as response:
                length = response.headers.get("content-length", "")
                if response.status_code == 200 and length.isdecimal():  # it says so; reading it may be refused later
                    return Piece(b"", int(length), _version(response))
                return Piece(b"", _total(response, 0, 1, address), _version(response))

        return _again(address, ask)

    @contextmanager
    def _asked(self, address: str, start: int, stop: int) -> Iterator[httpx.Response]:
        """The answer to one question, behind its redirects."""
        headers = {"Range": f"bytes={start}-{stop - 1}", "Accept-Encoding": "identity"}
        here, home, client = address, "", self._client(address)
        for _ in range(MAX_REDIRECTS + 1):
            own = self._headers() if same_host(here, address) else {}
            with client.stream("GET", here, headers={**headers, **own}) as response:
                peer = self._peer(response)
                home = home or peer
                if peer:
                    check_peer(address, here, home, peer)
                if not response.has_redirect_location:
                    _check_status(response, address)
                    yield response
                    return
                here = next_address(address, here, response.headers["location"])
        raise StoreError(f"{redact_uri(address)}: more than {MAX_REDIRECTS} redirects")

    def _peer(self, response: httpx.Response) -> str:
        """The machine that answered; empty where a proxy asks in our place, which then decides whom."""
        try:
            return "" if self._by_proxy else str(response.extensions["network_stream"].get_extra_info("server_addr")[0])
        except OSError as error:
            raise _PassingError(f"the connection broke ({type(error).__name__})") from None

    def _client(self, address: str) -> httpx.Client:
        """One for each process: a forked child must not read from its parent's connections."""
        process = os.getpid()
        if process not in self._clients:
            self._by_proxy = not is_loopback(address) and bool(_PROXIES.intersection(getproxies()))
            try:
                self._clients = {process: httpx.Client(timeout=_TIMES, trust_env=not is_loopback(address))}
            except (ImportError, ValueError, OSError, httpx.InvalidURL) as error:
                names = "HTTPS_PROXY, ALL_PROXY, NO_PROXY, SSL_CERT_FILE"
                why = type(error).__name__  # its message may hold the password of a proxy
                raise StoreError(
                    f"{redact_uri(address)} cannot be asked with what one of {names} says: {why}"
                ) from None
        return self._clients[process]


def _again(address: str, ask: Callable[[], Piece]) -> Piece:
    """What `ask` gives, tried five times where that can help."""
    wait = BACKOFF_S
    for attempt in range(1, ATTEMPTS + 1):
        try:
            return ask()
        except (_PassingError, httpx.TransportError) as error:
            asked = error.wait_s if isinstance(error, _PassingError) else None
            if attempt == ATTEMPTS or (asked or 0.0) > _LONGEST_WAIT_S:
                raise StoreError(
                    f"{redact_uri(address)}: {_said(error)} (asked {pluralize(attempt, 'time')})"
                ) from None
            time.sleep(wait if asked is None else asked)
            wait = min(2 * wait, _LONGEST_WAIT_S)
    raise AssertionError("the last attempt returns or raises")


def _check_status(response: httpx.Response, address: str) -> None:
    status = response.status_code
    if status in (200, 206, 416):
        return
    if status in (404, 410):
        raise FileNotFoundError(f"{redact_uri(address)}: there is no such file")
    if status in (401, 403):
        raise RefusedError(
            f"{redact_uri(address)}: the server refuses ({status}): it is private, the token is wrong, or, in a bucket that "
            "may not be listed, there is no such file"
        )
    if status in _PASSES:
        raise _PassingError(f"the server answers {status}", retry_after(response.headers))
    raise StoreError(f"{redact_uri(address)}: the server answers {status}")


def _total(response: httpx.Response, start: int, stop: int, address: str) -> int:
    """Length of the whole file, once the answer is what was asked for."""
    if response.headers.get("content-encoding", "identity") != "identity":
        raise StoreError(f"{redact_uri(address)}: the server compresses ranges: it must send files as they are")
    said = response.headers.get("content-range", "").strip()
    if response.status_code == 416:
        end = _PAST_THE_END.fullmatch(said)
        if end is None or int(end[1]) > start:
            raise StoreError(f"{redact_uri(address)}: the server refuses bytes {start} to {stop}")
        return int(end[1])
    if response.status_code == 200:
        length = response.headers.get("content-length", "")
        if start == 0 and length.isdecimal() and int(length) <= stop:
            return int(length)  # all of a small file
        raise StoreError(
            f"{redact_uri(address)}: the server does not serve ranges of bytes: put the dataset behind one that does, such "
            "as nginx, S3 or the Hub"
        )
    found = _RANGE.fullmatch(said)
    if found is None or (int(found[1]), int(found[2])) != (start, min(stop, int(found[3])) - 1):
        given = sanitize_line(said, 80) or "no Content-Range"
        raise StoreError(f"{redact_uri(address)}: asked for bytes {start} to {stop - 1}, the server gives {given}")
    return int(found[3])


def _version(response: httpx.Response) -> str:
    headers = response.headers
    return str(headers.get("etag") or headers.get("last-modified") or "")


def _receive(response: httpx.Response, data: bytearray, wanted: int, address: str) -> None:
    """Adds the body to `data` until there are `wanted` bytes."""
    if response.status_code == 416:
        return
    until = time.monotonic() + 60.0 + (wanted - len(data)) / _SLOWEST_BYTES_PER_S
    for chunk in response.iter_raw():
        data += chunk
        if len(data) > wanted:
            raise StoreError(f"{redact_uri(address)}: the answer is longer than it says")
        if time.monotonic() > until:
            raise _PassingError("the answer takes too long")
    if len(data) < wanted:
        raise _PassingError(f"the answer is cut short, {wanted - len(data)} bytes are missing")


def retry_after(headers: Mapping[str, str]) -> float | None:
    """How long a server asks to wait [s], where it says so in seconds."""
    said = headers.get("retry-after", "").strip()
    return float(said) if said.isdecimal() and len(said) < 10 else None


def _said(error: Exception) -> str:
    if isinstance(error, _PassingError):
        waits = f", and asks to wait {error.wait_s:.0f} s" if error.wait_s else ""
        return f"{error}{waits}"
    return f"no answer ({type(error).__name__}: {sanitize_line(str(error), 200)})"
