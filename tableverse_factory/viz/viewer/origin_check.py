"""Origin check of WebSocket connections: any web page may connect to a local port; only our own page is allowed."""

import logging
import socket
from collections.abc import Sequence
from ipaddress import ip_address
from urllib.parse import parse_qs, quote, urlsplit

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line

_MAX_PATH = 2000
_MAX_REFUSED = 100  # most refused origins that are logged

_PORTS = {"http": 80, "https": 443}

_log = logging.getLogger(__name__)


class OriginPolicy:
    """Allows pages of this server, and the origins that the user names."""

    def __init__(self, bound: str, allowed: Sequence[str] = ()) -> None:
        """Collect the names of this machine, which listens on the address `bound`, and the pages that are allowed.

        These are addresses of this server as browsers see it behind a proxy: `https://NAME.github.dev`, with a path if
        the proxy adds one; an invalid one raises `bad_origin`.
        """
        self._names = {"localhost", bound.lower(), socket.gethostname().lower()}
        self._pages: dict[tuple[str, str, int], str] = {}
        for address in allowed:
            origin = _split_origin(address)
            if origin is None:
                shown = sanitize_line(address, 100)
                raise InputError(f"--allow-origin {shown}: not the address of a page; give https://HOST", "bad_origin")
            self._pages[origin] = address.partition("?")[0].partition("#")[0].rstrip("/")
        self._refused: set[str] = set()

    def allows(self, origin: str | None, host: str | None) -> bool:
        """Check by the headers of a browser that it shows a page of this server; log a refusal.

        A foreign name that points here (DNS rebinding) sends itself as both headers: only numeric addresses and names
        of this machine count. Programs other than browsers send no `Origin`.
        """
        if origin is None:
            return True
        page, server = _split_origin(origin), _split_origin(f"http://{host}")
        if page is not None and page in self._pages:
            return True
        same = page is not None and server is not None and origin.partition("://")[2].lower() == str(host).lower()
        if same and page is not None and (page[1] in self._names or _is_ip_address(page[1])):
            return True
        self._log_refusal(sanitize_line(origin, 100))
        return False

    def make_link(self, scene_id: str, origin: str | None, host: str) -> str:
        """Make the address, relative to the page, that opens a scene, from the headers of an allowed browser."""
        parts = _split_origin(origin) if origin is not None else None
        page = self._pages.get(parts, "") if parts is not None else ""
        scheme, _, rest = (page or origin or f"http://{host}").partition("://")
        socket_scheme = "wss" if scheme.lower() == "https" else "ws"  # a page over TLS may open no other
        return f"?websocket={socket_scheme}://{quote(rest, safe='/:[].')}/?scene={quote(scene_id, safe='')}"

    def _log_refusal(self, origin: str) -> None:
        if origin not in self._refused and len(self._refused) < _MAX_REFUSED:
            self._refused.add(origin)
            _log.warning("refused a page of %s; if it is yours: --allow-origin %s", origin, origin)


def parse_scene_id(path: str) -> str | None:
    """Parse the scene that the address of a socket names, if any: `/?scene=ID`."""
    values = parse_qs(urlsplit(path[:_MAX_PATH]).query).get("scene")
    return values[0] if values else None


def _split_origin(address: str) -> tuple[str, str, int] | None:
    """Split the address of a page into scheme, host and port; None for an invalid one."""
    try:
        parts = urlsplit(address)
        port = parts.port
    except ValueError:
        return None
    if parts.scheme not in _PORTS or not parts.hostname or parts.username is not None or not address.isprintable():
        return None
    return parts.scheme, parts.hostname.lower(), port or _PORTS[parts.scheme]


def _is_ip_address(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:  # a name
        return False
    return True
