"""URLs of model servers: https except on this machine, and no secrets."""

import ipaddress
from typing import Annotated
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field

MAX_URL_CHARS = 2000


def is_loopback(url: str) -> bool:
    """Return whether a URL is on this machine."""
    host = urlsplit(url).hostname or ""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _check_url(url: str) -> str:
    """Check that keys and pictures may be sent to a URL; an empty one is allowed."""
    if not url:
        return url
    try:
        parts = urlsplit(url)
        _ = parts.port
    except ValueError as error:
        raise ValueError(f"is no address: {error}") from None
    if parts.scheme not in ("http", "https") or not parts.hostname or not url.isprintable() or " " in url:
        raise ValueError("is no address: give https://HOST/PATH")
    if parts.username is not None or parts.password is not None:
        raise ValueError("must hold no user name or password: keys come from an environment variable")
    if parts.query or parts.fragment:
        raise ValueError("must end with its path: no ? and no #")
    if parts.scheme == "http" and not is_loopback(url):
        raise ValueError("must begin with https: http would show key and pictures to everyone on the way")
    return url


ModelUrl = Annotated[str, Field(max_length=MAX_URL_CHARS), AfterValidator(_check_url)]
"""Base URL of a model server, or empty."""
