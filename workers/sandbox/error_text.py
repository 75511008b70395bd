"""Error texts as one bounded line that is the same on every machine: no addresses, temporary names or install paths."""

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


def make_failure(error: BaseException) -> Failed:
    """Make the failure of an exception; its kind is the class of our own errors, else `exception`."""
    if isinstance(error, MemoryError):
        return Failed("out_of_memory", sanitize_error_text(f"allocation refused: {error}"))
    if isinstance(error, TableverseError):
        return Failed(type(error).__name__, sanitize_error_text(str(error)))
    return Failed("exception", sanitize_error_text(f"{type(error).__name__}: {error}{_locate(error)}"))


def bound_drop(drop: Dropped) -> Dropped:
    """Bound the texts of a drop to one line each."""
    return Dropped(sanitize_error_text(drop.reason)[:MAX_CODE_CHARS], sanitize_error_text(drop.detail))


def bound_failure(failure: Failed) -> Failed:
    """Bound the texts of a failure to one line each."""
    return Failed(sanitize_error_text(failure.error_kind)[:MAX_CODE_CHARS], sanitize_error_text(failure.message))


def sanitize_error_text(text: str) -> str:
    """Remove line breaks, control characters and what differs between machines; at most 2,000 characters remain."""
    text = text[: 4 * MAX_DETAIL_CHARS]
    for pattern, word in _compile_machine_paths():
        text = pattern.sub(word, text)
    text = _ADDRESS.sub("0x…", text)
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return text if len(text) <= MAX_DETAIL_CHARS else text[: MAX_DETAIL_CHARS - 1] + "…"


@cache
def _compile_machine_paths() -> tuple[tuple[re.Pattern[str], str], ...]:
    """Compile patterns of install folders, longest first, and of names from `tempfile`."""
    temporary = re.compile(re.escape(tempfile.gettempdir()) + r"/tmp[a-z0-9_]{8}")  # noqa: S108 matched, not made
    folders = {str(_CODE_ROOT), sys.prefix, sys.base_prefix} - {"/", "/usr"}
    installed = [(re.compile(re.escape(folder) + "/"), "") for folder in sorted(folders, key=len, reverse=True)]
    return ((temporary, "<temporary>"), *installed)


def _locate(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if Path(f.filename).is_relative_to(_CODE_ROOT) and "site-packages" not in f.filename]
    return f" (at {ours[-1].filename}:{ours[-1].lineno})" if ours else ""
