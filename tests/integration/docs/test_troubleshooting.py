"""The page on troubleshooting has an entry for every error that a user can meet, and quotes messages as they are."""

import ast
import re
from collections.abc import Iterator

import pytest

from tableverse_factory.core import errors
from tests.helpers.paths import ROOT

PAGE = ROOT / "docs" / "troubleshooting.md"
LEAST_CHARS = 4
"""Shorter pieces between two `…` say nothing."""

REASONS = {"InputError": 1, "AnswerInvalidError": 1, "Dropped": 0, "Failed": 0}
"""Where the code stands among the arguments of each."""

_LITERALS_JOINED = re.compile(r"[\"']\s*\n\s*[fr]*[\"']")
_GIVES_CODES = re.compile(r"(Error|Dropped|Failed)\(")
_SOURCES = [path for folder in ("schemas", "tableverse_factory", "workers") for path in (ROOT / folder).rglob("*.py")]


def quoted() -> list[str]:
    """Every message or reason that the first column quotes."""
    rows = [line.split(" | ")[0] for line in PAGE.read_text().splitlines() if line.startswith("| ")]
    return [text for row in rows for text in re.findall(r"`([^`]+)`", row)]


def anchors() -> set[str]:
    return set(re.findall(r'<a id="([^"]+)">', PAGE.read_text()))


def codes() -> Iterator[str]:
    """Every code that an error or an outcome is given in the sources as a literal."""
    for text in filter(_GIVES_CODES.search, (path.read_text() for path in _SOURCES)):
        for call in ast.walk(ast.parse(text)):
            if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name)):
                continue
            named = [k.value for k in call.keywords if k.arg in ("reason", "error_kind", "topic")]
            place = REASONS.get(call.func.id)
            if place is not None:
                named += call.args[place : place + 1]
            elif not call.func.id.endswith("Error"):
                continue
            yield from (n.value for n in named if isinstance(n, ast.Constant) and isinstance(n.value, str))


@pytest.fixture(scope="module")
def source() -> str:
    files = [*_SOURCES, *(ROOT / "deploy").glob("*.sh")]
    return "\n".join(_LITERALS_JOINED.sub("", path.read_text()) for path in sorted(files))


@pytest.mark.parametrize("message", quoted())
def test_quoted_messages_exist(message: str, source: str) -> None:
    stem = re.sub(r"^(error: |detector_|judge_)", "", message)  # stages put their name before an answer's code
    pieces = [piece.strip() for piece in stem.split("…")]
    assert not [piece for piece in pieces if len(piece) >= LEAST_CHARS and piece not in source]


def test_every_code_has_an_anchor() -> None:
    found = set(codes())
    assert len(found) > 60
    assert sorted(found - anchors()) == []


def test_every_class_of_errors_has_an_anchor() -> None:
    topics = {c.topic for c in vars(errors).values() if isinstance(c, type) and issubclass(c, errors.TableverseError)}
    assert sorted(topics - anchors()) == []


def test_no_anchor_is_there_twice() -> None:
    found = re.findall(r'<a id="([^"]+)">', PAGE.read_text())
    assert sorted(set(found)) == sorted(found)
