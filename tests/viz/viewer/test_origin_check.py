"""Who may look: our own page, under names that nobody else can make point here, and what is named."""

import socket

import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.viz.viewer.origin_check import OriginPolicy, parse_scene_id

EVERYWHERE = "0.0.0.0"  # noqa: S104 - nothing listens here


@pytest.mark.parametrize(
    ("origin", "asked", "bound", "comes_in"),
    [
        ("http://127.0.0.1:8080", "127.0.0.1:8080", "127.0.0.1", True),
        ("http://localhost:9000", "localhost:9000", "127.0.0.1", True),  # forwarded by ssh
        ("http://[::1]:8080", "[::1]:8080", "::1", True),
        ("http://192.0.2.7:8080", "192.0.2.7:8080", EVERYWHERE, True),
        ("http://lab:8080", "lab:8080", "lab", True),
        (f"http://{socket.gethostname()}:8080", f"{socket.gethostname()}:8080", EVERYWHERE, True),
        (None, "127.0.0.1:8080", "127.0.0.1", True),
        ("https://known.example", "localhost:8080", "127.0.0.1", True),  # a proxy that was named
        ("http://known.example", "localhost:8080", "127.0.0.1", False),
        ("https://known.example:444", "localhost:8080", "127.0.0.1", False),
        ("https://evil.example", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://127.0.0.1:3000", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://evil.example:8080", "evil.example:8080", "127.0.0.1", False),  # a name that points here
        ("http://evil.example:8080", "evil.example:8080", EVERYWHERE, False),
        ("http://127.0.0.1.evil.example:8080", "127.0.0.1.evil.example:8080", "127.0.0.1", False),
        ("http://127.0.0.1:8080@evil.example", "127.0.0.1:8080@evil.example", "127.0.0.1", False),
        ("null", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://[", "[", "127.0.0.1", False),
        ("http://127.0.0.1:x", "127.0.0.1:x", "127.0.0.1", False),
        ("", "", "127.0.0.1", False),
        ("http://127.0.0.1:8080", None, "127.0.0.1", False),
    ],
)
def test_only_our_own_page_is_let_in(origin, asked, bound, comes_in):
    assert OriginPolicy(bound, ["https://known.example/proxy/8080/"]).allows(origin, asked) is comes_in


def test_a_refusal_is_told_once_and_not_without_end(caplog):
    door = OriginPolicy("127.0.0.1")
    for number in range(300):
        for _ in range(3):
            assert not door.allows(f"https://evil-{number}.example\x1b[2J", "127.0.0.1:8080")
    assert len(caplog.messages) == 100
    assert "\x1b" not in caplog.text


@pytest.mark.parametrize("address", ["", "lab", "ftp://lab", "http://[", "https://user@lab", "https://lab:x"])
def test_an_address_that_is_none_is_no_proxy(address):
    with pytest.raises(InputError, match="give https://HOST"):
        OriginPolicy("127.0.0.1", [address])


def test_an_address_names_its_scene():
    assert parse_scene_id("/?scene=a%20b-1") == "a b-1"
    assert parse_scene_id("/") is None
    link = OriginPolicy("127.0.0.1").make_link("a&b #1", "http://127.0.0.1:8080", "127.0.0.1:8080")
    assert link == "?websocket=ws://127.0.0.1:8080/?scene=a%26b%20%231"
