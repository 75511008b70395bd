"""Who may come in. A web page from anywhere may knock on a port of this machine; only our own page is let in."""

import logging
import socket
from collections.abc import Sequence
from ipaddress import ip_address
from urllib.parse import parse_qs, quote, urlsplit

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line

_MAX_PATH = 2000
_MAX_REFUSED = 100
"""So many origins that were turned away are told; who knocks with more of them only fills the terminal."""

_PORTS = {"http": 80, "https": 443}

_log = logging.getLogger(__name__)


class OriginPolicy:
    """Lets in pages of this server, and those that whoever started it names."""

    def __init__(self, bound: str, allowed: Sequence[str] = ()) -> None:
        """Knows the names of this machine.

        Args:
            bound: Address that this server listens on.
            allowed: Addresses of this server as browsers see it behind a proxy: `https://NAME.github.dev`, with a path
                where the proxy puts one.

        Raises:
            InputError: `bad_origin` for an address that is none.
        """
        self._names = {"localhost", bound.lower(), socket.gethostname().lower()}
        self._pages: dict[tuple[str, str, int], str] = {}
        for address in allowed:
            origin = _parts(address)
            if origin is None:
                said = sanitize_line(address, 100)
                raise InputError(f"--allow-origin {said}: no address of a page: give https://HOST", "bad_origin")
            self._pages[origin] = address.partition("?")[0].partition("#")[0].rstrip("/")
        self._refused: set[str] = set()

    def lets_in(self, origin: str | None, asked: str | None) -> bool:
        """Whether a browser that opens a socket shows the page that this server gave it; a refusal is logged.

        A page whose name was made to point here shows its own name as both: only addresses in numbers, which nobody can
        make point elsewhere, and names of this machine count.

        Args:
            origin: Header `Origin`: the page that asks. Programs that are no browsers send none.
            asked: Header `Host`: what it took this server for.
        """
        if origin is None:
            return True
        page, host = _parts(origin), _parts(f"http://{asked}")
        if page is not None and page in self._pages:
            return True
        same = page is not None and host is not None and origin.partition("://")[2].lower() == str(asked).lower()
        if same and page is not None and (page[1] in self._names or _is_number(page[1])):
            return True
        self._tell(sanitize_line(origin, 100))
        return False

    def link_to(self, scene_id: str, origin: str | None, asked: str) -> str:
        """The address, relative to the page, that opens a scene; what the page shows is in the socket's address.

        Args:
            scene_id: Which.
            origin: Header `Origin` of a browser that was let in.
            asked: Its header `Host`.
        """
        parts = _parts(origin) if origin is not None else None
        page = self._pages.get(parts, "") if parts is not None else ""
        scheme, _, rest = (page or origin or f"http://{asked}").partition("://")
        socket_scheme = "wss" if scheme.lower() == "https" else "ws"  # a page over TLS may open no other
        return f"?websocket={socket_scheme}://{quote(rest, safe='/:[].')}/?scene={quote(scene_id, safe='')}"

    def _tell(self, origin: str) -> None:
        if origin not in self._refused and len(self._refused) < _MAX_REFUSED:
            self._refused.add(origin)
            _log.warning("a page of %s was turned away; if it is yours: --allow-origin %s", origin, origin)


def wanted_scene(path: str) -> str | None:
    """The scene that the address of a socket names, if any: `/?scene=ID`."""
    values = parse_qs(urlsplit(path[:_MAX_PATH]).query).get("scene")
    return values[0] if values else None


def _parts(address: str) -> tuple[str, str, int] | None:
    """Scheme, host and port of a page's address; None if it is none."""
    try:
        parts = urlsplit(address)
        port = parts.port
    except ValueError:
        return None
    if parts.scheme not in _PORTS or not parts.hostname or parts.username is not None or not address.isprintable():
        return None
    return parts.scheme, parts.hostname.lower(), port or _PORTS[parts.scheme]


def _is_number(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:  # a name
        return False
    return True
