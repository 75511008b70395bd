"""Words for what a pydantic model refuses, in the terms of JSON and YAML."""

import reprlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from pydantic import ValidationError

_SHOWN_CHARS: Final = 80
_BRIEF: Final = reprlib.Repr()
_BRIEF.maxother = _SHOWN_CHARS
_MESSAGES: Final[Mapping[str, str]] = {
    "missing": "is missing",
    "extra_forbidden": "is no key here: leave it out",
    "tuple_type": "give a list",
    "list_type": "give a list",
    "model_type": "give keys and values",
    "model_attributes_type": "give keys and values",
    "dict_type": "give keys and values",
    "too_short": "give at least {min_length}",
    "too_long": "give at most {max_length}",
    "float_type": "give a number",
    "int_type": "give a whole number",
    "string_type": "give a text",
    "bool_type": "give true or false",
    "finite_number": "give a finite number",
    "greater_than": "give more than {gt:g}",
    "greater_than_equal": "give at least {ge:g}",
    "less_than": "give less than {lt:g}",
    "less_than_equal": "give at most {le:g}",
    "string_too_long": "give at most {max_length} characters",
    "string_pattern_mismatch": "give a text that matches {pattern}",
    "literal_error": "give {expected}",
    "enum": "give {expected}",
    "json_invalid": "it is no JSON: {error}",
    "union_tag_not_found": "{discriminator} is missing",
    "union_tag_invalid": "{discriminator}: give one of {expected_tags}, not {tag!r}",
}
_WITHOUT_VALUE: Final = {"json_invalid", "missing", "extra_forbidden", "union_tag_not_found", "union_tag_invalid"}


def describe_validation_error(error: "ValidationError", skipped: int = 0) -> str:
    """Describe the first problem of a validation in one line, `where: what, not value`; values are escaped and cut.

    The first `skipped` parts of the place are left out.
    """
    first: Mapping[str, Any] = error.errors(include_url=False)[0]
    kind, value = first["type"], first["input"]
    where = ".".join(str(part) for part in first["loc"][skipped:])
    wording = _MESSAGES.get(kind)
    message = first["msg"].removeprefix("Value error, ") if wording is None else wording.format(**first.get("ctx", {}))
    is_plain = isinstance(value, str | int | float | bool | None)
    is_shown = kind not in _WITHOUT_VALUE and (is_plain or kind.endswith("_type"))
    # Of other types only a value of the wrong type says more than the place
    text = represent(value) if is_shown else ""
    is_told = not text or (kind == "value_error" and isinstance(value, str) and text in message)
    given = "" if is_told else f", not {text}"
    return f"{where}: {message}{given}" if where else f"{message}{given}"


def represent(value: object) -> str:
    """Represent a value in few characters, which may be large; integers of thousands of digits have no text."""
    try:
        return _shorten(repr(value) if isinstance(value, str | int | float | bool | None) else _BRIEF.repr(value))
    except ValueError:
        return "an integer of thousands of digits"


def _shorten(text: str) -> str:
    plain = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text[: _SHOWN_CHARS + 1])
    return plain if len(plain) <= _SHOWN_CHARS else f"{plain[: _SHOWN_CHARS - 1]}…"
