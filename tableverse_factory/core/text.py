"""Untrusted text on its way to a terminal or a log: one bounded line without control characters."""

import json
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError


def sanitize_line(text: str, limit: int = 200) -> str:
    r"""`text` on one line, at most `limit` characters, everything unprintable (escapes, newlines) as `\x1b`."""
    shown = text[: limit + 1]
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)
    return shown if len(shown) <= limit else shown[: limit - 1] + "…"


def pluralize(number: int, thing: str) -> str:
    """`1 row`, `2 rows`: for nouns that take an s."""
    return f"{number} {thing}" if number == 1 else f"{number} {thing}s"


def describe_error(error: BaseException) -> str:
    """Why something failed, for people: the system's words without its number and path; a parser's with its place."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror[:1].lower()}{error.strerror[1:]}"
    if isinstance(error, json.JSONDecodeError):
        return f"{error.msg[:1].lower()}{error.msg[1:]}, line {error.lineno}, column {error.colno}"
    if isinstance(error, UnicodeDecodeError):
        return f"it is no text in {error.encoding.upper()}, from byte {error.start}"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    return " ".join(str(error).split()) or type(error).__name__


_PYDANTIC_MESSAGES = {
    "missing": "is missing",
    "tuple_type": "give a list",
    "list_type": "give a list",
    "model_type": "give keys and values",
    "dict_type": "give keys and values",
    "too_short": "give at least one",
}
"""What pydantic says in the terms of Python, for people who write JSON and YAML; by its code of the error."""


def describe_validation_error(error: "ValidationError") -> str:
    """The first thing that a validation found, as `where: what, not value`; long values are cut."""
    first = error.errors(include_url=False)[0]
    where = ".".join(str(part) for part in first["loc"])
    what = _PYDANTIC_MESSAGES.get(first["type"], first["msg"].removeprefix("Value error, "))
    value = first["input"]
    given = f", not {sanitize_line(repr(value), 80)}" if isinstance(value, str | int | float | bool | None) else ""
    return f"{where}: {what}{given}" if where else f"{what}{given}"
