"""Errors in one bounded line that reads the same everywhere: no addresses, no temporary names, no install paths."""

import re
import sys
import tempfile
import traceback
from functools import cache
from pathlib import Path

from schemas.outcome import MAX_DETAIL_CHARS, Dropped, Failed
from tableverse_factory.core.errors import TableverseError

MAX_CODE_CHARS = 80
_ADDRESS = re.compile(r"\b0x[0-9a-fA-F]{6,}\b")
_CODE_ROOT = Path(__file__).resolve().parents[2]


def failure_from_exception(error: BaseException) -> Failed:
    """What an exception is called in the dataset: the class of our own errors, else `exception` with its place."""
    if isinstance(error, MemoryError):
        return Failed("out_of_memory", one_line(f"allocation refused: {error}"))
    if isinstance(error, TableverseError):
        return Failed(type(error).__name__, one_line(str(error)))
    return Failed("exception", one_line(f"{type(error).__name__}: {error}{_place(error)}"))


def bounded_drop(drop: Dropped) -> Dropped:
    """A drop whose texts are one bounded line each."""
    return Dropped(one_line(drop.reason)[:MAX_CODE_CHARS], one_line(drop.detail))


def bounded_failure(failure: Failed) -> Failed:
    """A failure whose texts are one bounded line each."""
    return Failed(one_line(failure.error_kind)[:MAX_CODE_CHARS], one_line(failure.message))


def one_line(text: str) -> str:
    """The text without line breaks, control characters and what differs between machines; at most 2,000 characters."""
    text = text[: 4 * MAX_DETAIL_CHARS]
    for pattern, word in _machine_paths():
        text = pattern.sub(word, text)
    text = _ADDRESS.sub("0x…", text)
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return text if len(text) <= MAX_DETAIL_CHARS else text[: MAX_DETAIL_CHARS - 1] + "…"


@cache
def _machine_paths() -> tuple[tuple[re.Pattern[str], str], ...]:
    """Install folders, longest first, and names that `tempfile` makes up."""
    temporary = re.compile(re.escape(tempfile.gettempdir()) + r"/tmp[a-z0-9_]{8}")  # noqa: S108 matched, not made
    folders = {str(_CODE_ROOT), sys.prefix, sys.base_prefix} - {"/", "/usr"}
    installed = [(re.compile(re.escape(folder) + "/"), "") for folder in sorted(folders, key=len, reverse=True)]
    return ((temporary, "<temporary>"), *installed)


def _place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if Path(f.filename).is_relative_to(_CODE_ROOT) and "site-packages" not in f.filename]
    return f" (at {ours[-1].filename}:{ours[-1].lineno})" if ours else ""
