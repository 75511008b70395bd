"""JSON schemas of answers, in the subset that strict servers accept: every property required, nothing bounded.

Servers compile schemas to grammars and refuse large ones; bounds are checked when an answer is read.
"""

from typing import Any

Schema = dict[str, Any]

BOOLEAN: Schema = {"type": "boolean"}
INTEGER: Schema = {"type": "integer"}
NUMBER: Schema = {"type": "number"}
STRING: Schema = {"type": "string"}


def object_of(properties: Schema) -> Schema:
    """Build the schema of an object with exactly these properties."""
    return {"type": "object", "properties": properties, "required": [*properties], "additionalProperties": False}


def list_of(items: Schema) -> Schema:
    """Build the schema of a list of any length."""
    return {"type": "array", "items": items}


def enum_of(*values: str) -> Schema:
    """Build the schema of one of these words."""
    return {"type": "string", "enum": [*values]}


def nullable(value: Schema) -> Schema:
    """Build the schema of a value or null."""
    return {"anyOf": [value, {"type": "null"}]}
