"""The JSON schema of a detector's answer (paper appendix A), as strict servers take it.

Two things stand beside the paper's schema, and may be missing in an answer: `people`, the boxes of persons who are
visible with head and torso, and `held`; without them the rule of what is behind a person could not be checked here.
Everything is required and nothing is bounded, for servers compile schemas to grammars; our reading bounds everything.
"""

from typing import Any

from tableverse_factory.perceive.asked_prompt import BOX_KEYS, BoxOrder

Schema = dict[str, Any]

_BOOLEAN: Schema = {"type": "boolean"}
_INTEGER: Schema = {"type": "integer"}
_NUMBER: Schema = {"type": "number"}
_STRING: Schema = {"type": "string"}
_BOX: Schema = {"type": "array", "items": _NUMBER}


def answer_schema(order: BoxOrder) -> Schema:
    """The schema for a model that gives boxes in this order."""
    single, part = BOX_KEYS[order]
    container = {"label": _STRING, part: _BOX, "held": _BOOLEAN, "description": _STRING}
    content = {"label": _STRING, part: _BOX, "count": _INTEGER, "description": _STRING}
    composite = {
        "type": {"type": "string", "enum": ["container_fill"]},
        "description": _STRING,
        "container": _object(container),
        "contents": _list(_object(content)),
    }
    detection = {"label": _STRING, single: _BOX, "score": _NUMBER, "held": _BOOLEAN, "description": _STRING}
    lists = {"people": _BOX, "detections": _object(detection), "composites": _object(composite)}
    return _object({name: _list(items) for name, items in lists.items()})


def _object(properties: Schema) -> Schema:
    return {"type": "object", "properties": properties, "required": [*properties], "additionalProperties": False}


def _list(items: Schema) -> Schema:
    return {"type": "array", "items": items}
