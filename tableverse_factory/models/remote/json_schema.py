"""The few words of JSON schema in which answers are asked for, as strict servers take them.

Everything in an object is required and nothing is bounded: servers compile schemas to grammars and refuse large ones.
Whoever reads the answer bounds it.
"""

from typing import Any

Schema = dict[str, Any]

BOOLEAN: Schema = {"type": "boolean"}
INTEGER: Schema = {"type": "integer"}
NUMBER: Schema = {"type": "number"}
STRING: Schema = {"type": "string"}


def object_of(properties: Schema) -> Schema:
    """An object with exactly these properties."""
    return {"type": "object", "properties": properties, "required": [*properties], "additionalProperties": False}


def list_of(items: Schema) -> Schema:
    """Any number of these."""
    return {"type": "array", "items": items}


def enum_of(*values: str) -> Schema:
    """One of these words."""
    return {"type": "string", "enum": [*values]}


def nullable(value: Schema) -> Schema:
    """This or null."""
    return {"anyOf": [value, {"type": "null"}]}
