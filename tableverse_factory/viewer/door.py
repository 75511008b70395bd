"""Who may come in. A web page from anywhere may knock on a port of this machine; only our own page is let in."""

from ipaddress import ip_address
from urllib.parse import parse_qs, quote, urlsplit

_MAX_PATH = 2000


def is_loopback(host: str) -> bool:
    """Whether a name or address is of this machine alone."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:  # another name
        return False


def trusted(origin: str | None, asked: str | None, bound: str) -> bool:
    """Whether a browser that opens a socket shows the page that this server gave it.

    Args:
        origin: Header `Origin`: the page that asks. Programs that are no browsers send none.
        asked: Header `Host`: what it took this server for. A page whose name was made to point here shows its own.
        bound: Address that this server listens on.
    """
    if origin is None:
        return True
    page, host = urlsplit(origin), urlsplit(f"//{asked or ''}")
    if not asked or page.netloc.lower() != asked.lower():
        return False
    return not is_loopback(bound) or is_loopback(host.hostname or "")


def wanted_scene(path: str) -> str | None:
    """The scene that the address of a socket names, if any: `/?scene=ID`."""
    values = parse_qs(urlsplit(path[:_MAX_PATH]).query).get("scene")
    return values[0] if values else None


def link_to(scene_id: str, asked: str) -> str:
    """The address, relative to the page, that opens a scene; what the page shows at first is in the socket's address.

    Args:
        scene_id: Which.
        asked: Header `Host` of the browser.
    """
    return f"?websocket=ws://{quote(asked, safe=':[].')}/?scene={quote(scene_id, safe='')}"
