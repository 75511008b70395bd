"""The judge's seven outputs (paper section 3.3, appendix B): the answer as text, and the verdict after our checks."""

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from schemas.identity import clean_label

Label = Annotated[str, Field(max_length=4000), AfterValidator(clean_label)]
Score = Annotated[int, Field(ge=1, le=10)]
Unit = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class Relation(StrEnum):
    """The ten spatial relations of a pick-and-place task."""

    ON = "on"
    IN = "in"
    INTO = "into"
    NEXT_TO = "next to"
    LEFT = "to the left of"
    RIGHT = "to the right of"
    BEHIND = "behind"
    IN_FRONT = "in front of"
    INSIDE = "inside"
    OUTSIDE = "outside"


HINGE_CATEGORIES = ("Bottle", "Box", "Bucket", "Laptop", "Pliers", "Scissors", "TrashCan")


class _Answer(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, populate_by_name=True)


class Usability(_Answer):
    """Part A."""

    usable: bool
    reason_codes: tuple[Literal["EXTREME_REGIONAL_PARTITION", "NON_TABLETOP_OBJECT"], ...] = ()
    evidence_ids: dict[str, tuple[int, ...]] = Field(default_factory=dict)


class SevereLabelError(_Answer):
    """Part B."""

    has_severe_label_error: bool = False
    evidence_ids: tuple[int, ...] = ()
    correct_labels: dict[str, Label] = Field(default_factory=dict)


class PhysicalProperties(_Answer):
    """Part D."""

    mass_kg: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    has_hinge: bool = False
    hinge_category: str | None = None


class CriterionScore(_Answer):
    """One of the four criteria of part E, with the ids it names."""

    score: Score
    bad_geometry_ids: tuple[int, ...] = ()
    graspable_ids: tuple[int, ...] = ()
    ungraspable_ids: tuple[int, ...] = ()


class PerCriterion(_Answer):
    """Part E: weights 45, 15, 15 and 25 in a hundred."""

    category_diversity: CriterionScore
    geometric_plausibility: CriterionScore
    graspability: CriterionScore
    layout_clarity: CriterionScore


class Relabelling(_Answer):
    """Part F."""

    relabel_name: Label
    distinguishing_phrases: Annotated[tuple[Label, ...], Field(max_length=20)] = ()


class GeneratedTask(_Answer):
    """Part G."""

    instruction: Annotated[str, Field(max_length=1000)]
    x_id: int = Field(alias="X_id")
    x_name: Label = Field(alias="X_name")
    y_id: int = Field(alias="Y_id")
    y_name: Label = Field(alias="Y_name")
    relation: Annotated[str, Field(max_length=100)]
    initial_relation_satisfied: bool = False


class JudgeAnswer(_Answer):
    """The paper's output schema. Integer ids count the scene's objects from 0; dict keys are those ids as text."""

    usability: Usability
    severe_label_error: SevereLabelError = Field(default_factory=SevereLabelError)
    label_confidence: dict[str, Unit] = Field(default_factory=dict)
    physical_properties: dict[str, PhysicalProperties] = Field(default_factory=dict)
    per_criterion: PerCriterion
    object_relabeling: dict[str, Relabelling] = Field(default_factory=dict)
    final_score: Score
    generated_tasks: Annotated[tuple[GeneratedTask, ...], Field(max_length=500)] = ()


class ObjectAssessment(_Answer):
    """What the dataset says of one object after the checks; object ids are strings (`obj_000`)."""

    object_id: str
    relabel_name: Label
    distinguishing_phrases: tuple[Label, ...] = ()
    label_confidence: Unit
    label_error: bool = False
    corrected_label: str = ""
    mass_kg: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    answered_mass_kg: float | None = None
    """What the judge said, before it was clipped to what the volume allows [kg]; None where the rules filled it in."""
    mass_clipped: bool = False
    has_hinge: bool = False
    hinge_category: str | None = None
    graspable: bool = False
    bad_geometry: bool = False
    non_tabletop: bool = False
    from_rules: tuple[str, ...] = ()
    """Parts of the answer that lacked this object and were filled by the rules."""


class TaskAssessment(_Answer):
    """A task and its verdict; a refused task stays in the manifest with its reason."""

    task_id: str
    instruction: str
    x_id: str
    y_id: str
    relation: str
    source: str
    accepted: bool
    refusal: str = ""


class JudgeRemark(_Answer):
    """One thing of an answer that was not taken as it stood; tasks have their own `refusal`."""

    code: str
    object_id: str = ""
    detail: str = ""


class AnswerOrigin(_Answer):
    """Where an answer comes from; empty where no model was asked."""

    model: str = ""
    prompt_sha256: str = ""
    rounds: int = 0
    """1, or 2 where the first answer had to be repaired."""


class Agreement(_Answer):
    """How far a judge and the rules agree on a scene."""

    rules_usable: bool
    rules_score: int
    names_share: Unit
    """Of the objects: those that both call by the same noun."""
    mass_ratio: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    """The judge's masses, as clipped, over the rules', median over the objects."""
    rules_tasks: int
    shared_tasks: int
    """Accepted tasks with the same two objects and relation on both sides."""


class Assessment(_Answer):
    """The verdict on one scene; `answer_json` keeps the judge's own words, whole."""

    usable: bool
    reason_codes: tuple[str, ...] = ()
    severe_label_error: bool = False
    quality_score: Score
    criterion_scores: dict[str, int]
    objects: tuple[ObjectAssessment, ...]
    tasks: tuple[TaskAssessment, ...]
    answered_usable: bool | None = None
    answered_score: int | None = None
    remarks: tuple[JudgeRemark, ...] = ()
    origin: AnswerOrigin = AnswerOrigin()
    agreement: Agreement | None = None
    """None where the rules judged."""
    answer_json: str = ""
