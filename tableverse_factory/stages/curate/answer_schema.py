"""The JSON schema of an answer (paper appendix B) for a scene of n objects, as strict servers take it.

Every id is spelled out, so that a server that enforces schemas cannot leave an object out.
"""

from schemas.curation import HINGE_CATEGORIES, Relation
from tableverse_factory.models.remote.json_schema import BOOLEAN, INTEGER, NUMBER, STRING, Schema, list_of, object_of

_IDS: Schema = {"type": "array", "items": INTEGER}


def build_judge_schema(n_objects: int) -> Schema:
    """The schema for ids 0 to n - 1."""
    ids = [str(index) for index in range(n_objects)]
    hinge = _or_null({"type": "string", "enum": list(HINGE_CATEGORIES)})
    physical = _object(mass_kg=NUMBER, has_hinge=BOOLEAN, hinge_category=hinge)
    names = _object(relabel_name=STRING, distinguishing_phrases=list_of(STRING))
    return _object(
        usability=_object(
            usable=BOOLEAN,
            reason_codes=list_of({"type": "string", "enum": ["EXTREME_REGIONAL_PARTITION", "NON_TABLETOP_OBJECT"]}),
            evidence_ids=_object(NON_TABLETOP_OBJECT=_IDS),
        ),
        severe_label_error=_object(
            has_severe_label_error=BOOLEAN, evidence_ids=_IDS, correct_labels=_each(ids, _or_null(STRING))
        ),
        label_confidence=_each(ids, NUMBER),
        physical_properties=_each(ids, physical),
        per_criterion=_object(
            category_diversity=_object(score=INTEGER),
            geometric_plausibility=_object(score=INTEGER, bad_geometry_ids=_IDS),
            graspability=_object(score=INTEGER, graspable_ids=_IDS, ungraspable_ids=_IDS),
            layout_clarity=_object(score=INTEGER),
        ),
        object_relabeling=_each(ids, names),
        final_score=INTEGER,
        generated_tasks=list_of(_build_task()),
    )


def _build_task() -> Schema:
    return _object(
        instruction=STRING,
        X_id=INTEGER,
        X_name=STRING,
        Y_id=INTEGER,
        Y_name=STRING,
        relation={"type": "string", "enum": [relation.value for relation in Relation]},
        initial_relation_satisfied=BOOLEAN,
    )


def _object(**properties: Schema) -> Schema:
    return object_of(properties)


def _each(ids: list[str], value: Schema) -> Schema:
    return object_of(dict.fromkeys(ids, value))


def _or_null(value: Schema) -> Schema:
    return {"anyOf": [value, {"type": "null"}]}
