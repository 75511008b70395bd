"""Checks on redirects: never from a public into a private network, never from https to http."""

import ipaddress
import socket
from urllib.parse import urljoin, urlsplit

from tableverse_factory.core.errors import StoreError
from tableverse_factory.core.storage.files import MAX_URI_CHARS, redact_uri

MAX_REDIRECTS = 5
_MAX_CHARS = 8 * MAX_URI_CHARS  # signed addresses are long

_PORTS = {"http": 80, "https": 443}
_NAT64 = ipaddress.ip_network("64:ff9b::/96")
_METADATA_HOSTS = frozenset({ipaddress.ip_address("168.63.129.16")})
"""Public by number, yet answered by the host of a virtual machine (Azure)."""


def resolve_redirect(first: str, here: str, location: str) -> str:
    """Resolve and check the untrusted `location` of a redirect by `here`; a person named `first`.

    Raises:
        StoreError: if it is no address on the web, leaves https, or leads to another kind of network than `first` is
            in: a server on the open network could make this machine read from its own, or from services that only
            answer its neighbours.
    """
    try:
        address = urljoin(here, location)
        parts = urlsplit(address)
        _ = parts.port
    except ValueError:
        raise StoreError(f"{redact_uri(first)}: redirected to what is no address") from None
    if parts.scheme not in _PORTS or not parts.hostname or len(address) > _MAX_CHARS or not address.isprintable():
        raise StoreError(f"{redact_uri(first)}: redirected to what is no address of the web")
    if urlsplit(first).scheme == "https" and parts.scheme != "https":
        raise StoreError(f"{redact_uri(first)}: redirected from https to http, to {redact_uri(address)}")
    if not is_same_origin(address, first):
        beyond = find_networks(address) - {"public"} - find_networks(first)
        if beyond:
            raise StoreError(f"{redact_uri(first)}: redirected to {redact_uri(address)}, a {min(beyond)} address")
    return address


def check_peer(first: str, here: str, home: str, peer: str) -> None:
    """Refuse an answer from a `peer` that is neither public nor in the network of `home`, which answered for `first`.

    A name may lead elsewhere a moment later, when the connection is made; the machine that answered is what counts. A
    request without headers of ours has reached it by then, and nothing of its answer is read.
    """
    kind = classify_address(peer)
    if kind not in ("public", classify_address(home)):
        raise StoreError(f"{redact_uri(first)}: redirected to {redact_uri(here)}, a {kind} address")


def is_same_origin(one: str, other: str) -> bool:
    """Check whether two addresses have scheme, host and port in common."""
    return _origin(one) == _origin(other)


def _origin(address: str) -> tuple[str, str, int]:
    parts = urlsplit(address)
    return parts.scheme, parts.hostname or "", parts.port or _PORTS.get(parts.scheme, 0)


def find_networks(address: str) -> frozenset[str]:
    """Classify the networks of a host's addresses: `public`, `private`, `loopback`, `link-local`, `special`.

    A name that this machine cannot look up counts as public: a proxy may know it, and if not, `check_peer` decides.
    """
    host = urlsplit(address).hostname or ""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return frozenset({"public"})
    return frozenset(classify_address(str(entry[4][0])) for entry in found)


def classify_address(text: str) -> str:
    """Classify an address, or the IPv4 one it wraps: `public`, `private`, `loopback`, `link-local`, `special`."""
    address = ipaddress.ip_address(text.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address):
        inner = address.ipv4_mapped or address.sixtofour
        if inner is None and address in _NAT64:
            inner = ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
        if inner is not None:
            return classify_address(str(inner))
        if address.is_site_local:
            return "private"
    if address.is_loopback:
        return "loopback"
    if address.is_link_local:
        return "link-local"
    if address.is_multicast or address.is_reserved or address.is_unspecified or address in _METADATA_HOSTS:
        return "special"
    return "public" if address.is_global else "private"
