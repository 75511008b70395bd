"""End of a command: its exit code, and the message of an error with a link to its explanation."""

import difflib
import errno
import io
import os
import re
import select
import sys
from collections.abc import Callable
from typing import Any

from typer import Abort
from typer.exceptions import TyperException  # of all that says that a command line is wrong

from tableverse_factory.core.errors import TableverseError
from tableverse_factory.core.text import sanitize_line

FAILED, USAGE_ERROR, INTERRUPTED, BROKEN_PIPE = 1, 2, 130, 141
TROUBLESHOOTING = "docs/troubleshooting.md"

_REMEDIES = {
    errno.ENOSPC: "make room, then run the same command again",
    errno.EFBIG: "the limit on the size of a file is too low: ulimit -f unlimited",
    errno.EDQUOT: "make room, then run the same command again",
    errno.EACCES: "look whose it is with ls -l, or give another path",
    errno.EROFS: "give a path that can be written",
    errno.EMFILE: "too many files are open: ulimit -n 4096, then run the same command again",
    errno.EADDRINUSE: "another program has this port: give another, or end that program",
}
_EXAMPLE = re.compile(r"Example: `([^`]+)`")


def run_command(command: Callable[[], object]) -> int:
    """Run a command of a Typer app outside its stand-alone mode, print its error, if any, and return the exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal without a letter shows its code, not a traceback
    try:
        code = command()
        sys.stdout.flush()
    except (SystemExit, BrokenPipeError) as end:
        code = _resolve_exit(end)
    except KeyboardInterrupt:
        code = INTERRUPTED
    except Abort:
        code = FAILED
    except Exception as error:
        if os.environ.get("TABLEVERSE_DEBUG") or (message := _describe_error(error)) is None:
            raise
        if message:
            print(f"error: {message}", file=sys.stderr)
        if topic := "bad_table" if _is_parquet_error(error) else getattr(error, "topic", ""):
            print(f"help: {TROUBLESHOOTING}#{topic}", file=sys.stderr)
        code = USAGE_ERROR if isinstance(error, TyperException) else FAILED
    return code if isinstance(code, int) else 0


def _resolve_exit(end: SystemExit | BrokenPipeError) -> object:
    """Find the code of a process whose output may have lost its reader, as in `… | head -1`."""
    if _is_stdout_broken():
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains when it flushes at its end
        return BROKEN_PIPE
    if isinstance(end, SystemExit):  # rich has done the same already when it raises one
        return BROKEN_PIPE if isinstance(end.__context__, BrokenPipeError) else end.code
    print(f"error: {end.strerror}: a process that was to read ended early", file=sys.stderr)
    return FAILED


def _is_stdout_broken() -> bool:
    try:
        poll = select.poll()
        poll.register(sys.stdout.fileno(), 0)
    except (OSError, ValueError):  # closed, or not a file of the system
        return False
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _describe_error(error: Exception) -> str | None:
    """Describe an expected error; None for a defect of ours, which shows its traceback."""
    if isinstance(error, TyperException):
        return _describe_usage_error(error)
    if isinstance(error, TableverseError):
        return str(error)
    if isinstance(error, OSError):
        remedy = _REMEDIES.get(error.errno or 0)
        what = f"{error.filename or type(error).__name__}: {error.strerror or error}"
        return f"{what}: {remedy}" if remedy else what
    if _is_parquet_error(error):
        return (
            f"a Parquet file is damaged: {' '.join(str(error).split())[:400]}; "
            "of a dataset, delete the file of that name in scenes/, and the same build makes the shard again"
        )
    if type(error).__module__.partition(".")[0] in ("aiohttp", "botocore"):
        return f"the object store broke off an answer ({type(error).__name__}): run the same command again"
    return None


def _is_parquet_error(error: Exception) -> bool:
    return isinstance(error, ValueError) and type(error).__module__.partition(".")[0] == "pyarrow"


def _describe_usage_error(error: Any) -> str:
    """Describe what is wrong with a command line and what to type instead; empty if its help was shown."""
    context, parameter = getattr(error, "ctx", None), getattr(error, "param", None)
    if context is None:
        return sanitize_line(error.format_message(), 500)  # such as an option without its value
    if not error.message and parameter is None:
        return ""
    help_of_it = f"{context.command_path} --help"
    example = _EXAMPLE.search(context.command.help or "")
    shown = f"\nfor example: {example[1]}" if example else f"\nsee: {help_of_it}"
    if hasattr(error, "possibilities"):
        return f"{_describe_unknown_option(error.option_name, context)}\nsee: {help_of_it}"
    if hasattr(error, "param_type"):
        return f"{' / '.join(_list_names(parameter))} is missing{shown}"
    message = error.message.removeprefix("Value error, ").removeprefix("Input ").removesuffix(".")
    if parameter is None:
        message = f"{hint}: {message}" if (hint := getattr(error, "param_hint", None)) else message
        return f"{message[:1].lower()}{message[1:]}{shown}"
    refused = _format_refused_value(error)
    if refused.lower().strip("'+- ") == "nan":  # of which it would be wrong to say that it is too large
        message = "is not a number"
    return f"{' / '.join(_list_names(parameter))}: {refused}{message}\nsee: {help_of_it}"


def _describe_unknown_option(option: str, context: Any) -> str:
    known = [name for parameter in context.command.params for name in _list_names(parameter) if name.startswith("--")]
    near = difflib.get_close_matches(option, [*known, "--help"], n=1)
    return f"no option {sanitize_line(option, 80)}" + (f"; did you mean {near[0]}?" if near else "")


def _list_names(parameter: Any) -> list[str]:
    """List all names of an option, or the word of an argument in the usage."""
    if parameter.param_type_name == "option":
        return [*parameter.opts, *parameter.secondary_opts]
    return [parameter.display_name_raw.upper()]


def _format_refused_value(error: Any) -> str:
    """Format the refused value if the message lacks it: a number out of its bounds."""
    list_errors = getattr(error.__cause__, "errors", None)
    if list_errors is None or error.message.startswith("Value error, "):
        return ""
    return f"{sanitize_line(str(list_errors()[0]['input']), 80)!r} "
