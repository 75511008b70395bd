"""Description of what a policy raised: its text, and where."""

import sysconfig
import traceback
from contextlib import suppress
from pathlib import Path
from types import FrameType

from tableverse_factory.core.text import sanitize_line

MAX_PLACE_CHARS = 80
_OURS = Path(__file__).parents[2]
_INSTALLED = tuple({Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")})


def describe_failure(error: Exception, limit: int) -> str:
    """Describe what a policy raised in at most `limit` characters: kind and text, and file and line where it arose."""
    text = type(error).__name__
    with suppress(Exception):  # even the text of an error may be one
        text = f"{text}: {error}"
    place = _find_place(error)
    shown = sanitize_line(" ".join(text.split()), limit - len(place) - 3)
    return f"{shown} ({place})" if place else shown


def _find_place(error: Exception) -> str:
    """Find the innermost line of the policy's own code; empty without any."""
    frames = [each for each in traceback.walk_tb(error.__traceback__) if not _lies_in(each[0], _OURS)]
    frames = [each for each in frames if not each[0].f_code.co_filename.startswith("<")]  # of no file
    own = [each for each in frames if not any(_lies_in(each[0], folder) for folder in _INSTALLED)]
    if frames and not own:  # it is installed: the first package that ours calls
        own = [each for each in frames if _find_package(each[0]) == _find_package(frames[0][0])]
    return _name_place(*own[-1]) if own else ""


def _find_package(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__", "")).partition(".")[0]


def _lies_in(frame: FrameType, folder: Path) -> bool:
    return Path(frame.f_code.co_filename).is_relative_to(folder)


def _name_place(frame: FrameType, line: int) -> str:
    """Name file and line; as much of the path as the module's name has parts is the same on every machine."""
    path = Path(frame.f_code.co_filename)
    parts = str(frame.f_globals.get("__name__", "")).count(".") + (2 if path.name == "__init__.py" else 1)
    return sanitize_line("/".join(path.parts[-parts:]), MAX_PLACE_CHARS - 12) + f":{line}"
