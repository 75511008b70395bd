"""The JSON schema of an answer (paper appendix B) for a scene of n objects, as strict servers take it.

Every id is spelled out and everything is required, so that a server that enforces schemas cannot leave an object out.
There are no bounds and no lengths: servers compile schemas to grammars, and refuse large ones. The checks of the answer
bound everything.
"""

from typing import Any

from schemas.curation import HINGE_CATEGORIES, Relation

Schema = dict[str, Any]

_BOOLEAN: Schema = {"type": "boolean"}
_INTEGER: Schema = {"type": "integer"}
_NUMBER: Schema = {"type": "number"}
_STRING: Schema = {"type": "string"}
_IDS: Schema = {"type": "array", "items": _INTEGER}


def answer_schema(n_objects: int) -> Schema:
    """The schema for ids 0 to n - 1."""
    ids = [str(index) for index in range(n_objects)]
    hinge = _or_null({"type": "string", "enum": list(HINGE_CATEGORIES)})
    physical = _object(mass_kg=_NUMBER, has_hinge=_BOOLEAN, hinge_category=hinge)
    names = _object(relabel_name=_STRING, distinguishing_phrases=_list(_STRING))
    return _object(
        usability=_object(
            usable=_BOOLEAN,
            reason_codes=_list({"type": "string", "enum": ["EXTREME_REGIONAL_PARTITION", "NON_TABLETOP_OBJECT"]}),
            evidence_ids=_object(NON_TABLETOP_OBJECT=_IDS),
        ),
        severe_label_error=_object(
            has_severe_label_error=_BOOLEAN, evidence_ids=_IDS, correct_labels=_each(ids, _or_null(_STRING))
        ),
        label_confidence=_each(ids, _NUMBER),
        physical_properties=_each(ids, physical),
        per_criterion=_object(
            category_diversity=_object(score=_INTEGER),
            geometric_plausibility=_object(score=_INTEGER, bad_geometry_ids=_IDS),
            graspability=_object(score=_INTEGER, graspable_ids=_IDS, ungraspable_ids=_IDS),
            layout_clarity=_object(score=_INTEGER),
        ),
        object_relabeling=_each(ids, names),
        final_score=_INTEGER,
        generated_tasks=_list(_task()),
    )


def _task() -> Schema:
    return _object(
        instruction=_STRING,
        X_id=_INTEGER,
        X_name=_STRING,
        Y_id=_INTEGER,
        Y_name=_STRING,
        relation={"type": "string", "enum": [relation.value for relation in Relation]},
        initial_relation_satisfied=_BOOLEAN,
    )


def _object(**properties: Schema) -> Schema:
    return {"type": "object", "properties": properties, "required": [*properties], "additionalProperties": False}


def _each(ids: list[str], value: Schema) -> Schema:
    return _object(**dict.fromkeys(ids, value))


def _list(items: Schema) -> Schema:
    return {"type": "array", "items": items}


def _or_null(value: Schema) -> Schema:
    return {"anyOf": [value, {"type": "null"}]}
