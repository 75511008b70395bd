"""The JSON schema of a detector's answer (paper appendix A), as strict servers take it.

Two things stand beside the paper's schema, and may be missing in an answer: `people`, the boxes of persons who are
visible with head and torso, and `held`; without them the rule of what is behind a person could not be checked here.
"""

from tableverse_factory.models.remote.json_schema import BOOLEAN, INTEGER, NUMBER, STRING, Schema, list_of, object_of
from tableverse_factory.stages.perceive.vlm.prompt import BOX_KEYS, BoxOrder

_BOX: Schema = {"type": "array", "items": NUMBER}


def build_detection_schema(order: BoxOrder) -> Schema:
    """The schema for a model that gives boxes in this order."""
    single, part = BOX_KEYS[order]
    container = {"label": STRING, part: _BOX, "held": BOOLEAN, "description": STRING}
    content = {"label": STRING, part: _BOX, "count": INTEGER, "description": STRING}
    composite = {
        "type": {"type": "string", "enum": ["container_fill"]},
        "description": STRING,
        "container": object_of(container),
        "contents": list_of(object_of(content)),
    }
    detection = {"label": STRING, single: _BOX, "score": NUMBER, "held": BOOLEAN, "description": STRING}
    lists = {"people": _BOX, "detections": object_of(detection), "composites": object_of(composite)}
    return object_of({name: list_of(items) for name, items in lists.items()})
