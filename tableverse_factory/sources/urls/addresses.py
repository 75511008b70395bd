"""Checks on addresses that may be fetched: http and https, no secrets, no hosts of this machine's network."""

import asyncio
import socket
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import httpcore
import httpx

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.http_redirects import classify_address
from tableverse_factory.core.text import sanitize_line

MAX_URL_CHARS = 4096
MAX_PORT = 65535
_MAX_ADDRESSES = 4


def parse_url(text: str) -> httpx.URL:
    """Parse and check an address, or raise `bad_url` in words that hold nothing secret of it."""
    try:
        url = httpx.URL(text)
    except (httpx.InvalidURL, ValueError, TypeError):
        raise InputError("it is no address: give https://HOST/PATH", "bad_url") from None
    if url.scheme not in ("http", "https"):
        raise InputError(f"{sanitize_line(url.scheme, 20) or 'no scheme'}: only http and https are fetched", "bad_url")
    if not url.raw_host:
        raise InputError("it names no host: give https://HOST/PATH", "bad_url")
    if url.port is not None and not 0 < url.port <= MAX_PORT:
        raise InputError(f"there is no port {sanitize_line(str(url.port), 20)}", "bad_url")
    if url.userinfo:
        raise InputError("it holds a user name or password: a picture for all needs none", "bad_url")
    return url.copy_with(fragment=None)


def redact_url(text: str) -> str:
    """Redact an address for manifests and messages: without user, password, query and fragment."""
    try:
        url = httpx.URL(text).copy_with(userinfo=b"", query=None, fragment=None)
    except (httpx.InvalidURL, ValueError, TypeError):
        # Where a password ends in an invalid address is undecidable.
        return sanitize_line(text.partition("?")[0].partition("#")[0].rpartition("@")[2], 200)
    return sanitize_line(str(url), MAX_URL_CHARS)


class CheckedNetworkBackend(httpcore.AsyncNetworkBackend):
    """Network backend that connects to checked addresses only.

    A name is resolved here, every address of it is checked, and the connection goes to a checked one: a name that
    resolves to something else a moment later gains nothing. TLS still proves the name.
    """

    def __init__(self, allow_private: bool, connect_s: float, lookups: ThreadPoolExecutor) -> None:
        self._allow_private, self._connect_s, self._lookups = allow_private, connect_s, lookups
        self._network = httpcore.AnyIOBackend()

    async def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[httpcore.SOCKET_OPTION] | None = None,
    ) -> httpcore.AsyncNetworkStream:
        """Connect to the first address of the host that answers; the first few share the time.

        Raises:
            InputError: `private_address` if any address of the host is none of the internet's.
            httpcore.ConnectError: if the name is unknown or no address answers.
        """
        error: Exception = httpcore.ConnectError(f"{sanitize_line(host)} has no address")
        addresses = (await self._resolve(host, port))[:_MAX_ADDRESSES]
        share_s = min(self._connect_s if timeout is None else timeout, self._connect_s) / max(len(addresses), 1)
        for address in addresses:
            try:
                return await self._network.connect_tcp(address, port, share_s, local_address, socket_options)
            except (httpcore.ConnectError, httpcore.ConnectTimeout) as refused:
                error = refused
        raise error

    async def _resolve(self, host: str, port: int) -> list[str]:
        try:
            found = await asyncio.get_running_loop().run_in_executor(
                self._lookups, socket.getaddrinfo, host, port, 0, socket.SOCK_STREAM
            )
        except (OSError, UnicodeError) as error:
            raise httpcore.ConnectError(f"{sanitize_line(host)} is not known") from error
        addresses = list(dict.fromkeys(str(entry[4][0]) for entry in found))
        if not self._allow_private:
            for address in addresses:
                if classify_address(address) != "public":
                    named = sanitize_line(host) if host == address else f"{sanitize_line(host)} is {address}, which"
                    remedy = "--allow-private lets lists reach into this network"
                    raise InputError(f"{named} is no address of the internet: {remedy}", "private_address")
        return addresses

    async def sleep(self, seconds: float) -> None:
        """Sleep [s]."""
        await asyncio.sleep(seconds)
