"""The page on troubleshooting quotes messages as they are: a reader looks for what stands on the screen."""

import re

import pytest

from tests.helpers.paths import ROOT

PAGE = ROOT / "docs" / "troubleshooting.md"
LEAST_CHARS = 4
"""Shorter pieces between two `…` say nothing."""

_LITERALS_JOINED = re.compile(r"[\"']\s*\n\s*[fr]*[\"']")


def quoted() -> list[str]:
    """Every message or reason that the first column quotes."""
    rows = [line.split(" | ")[0] for line in PAGE.read_text().splitlines() if line.startswith("| ")]
    return [text for row in rows for text in re.findall(r"`([^`]+)`", row)]


@pytest.fixture(scope="module")
def source() -> str:
    files = [path for folder in ("schemas", "tableverse_factory", "workers") for path in (ROOT / folder).rglob("*.py")]
    files += (ROOT / "deploy").glob("*.sh")
    return "\n".join(_LITERALS_JOINED.sub("", path.read_text()) for path in sorted(files))


@pytest.mark.parametrize("message", quoted())
def test_what_is_quoted_is_said_somewhere(message: str, source: str) -> None:
    pieces = [piece.strip() for piece in message.removeprefix("error: ").split("…")]
    missing = [piece for piece in pieces if len(piece) >= LEAST_CHARS and piece not in source]
    assert not missing


def test_there_is_something_to_check() -> None:
    assert len(quoted()) > 20
