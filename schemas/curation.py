"""The judge's seven outputs (paper section 3.3, appendix B): the raw answer, and the verdict after our checks."""

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


INSTRUCTION = "Pick up {x} and place it {relation} {y}"
"""Template of a task's instruction (paper appendix B)."""

HINGE_CATEGORIES = ("Bottle", "Box", "Bucket", "Laptop", "Pliers", "Scissors", "TrashCan")


class Answer(BaseModel):
    """Base of answers of models and of what is made of them: unknown keys are ignored."""

    # built at the first use: few of the processes that import answers ask a model
    model_config = ConfigDict(extra="ignore", frozen=True, populate_by_name=True, defer_build=True)


class Usability(Answer):
    """Part A."""

    usable: bool
    reason_codes: tuple[Literal["EXTREME_REGIONAL_PARTITION", "NON_TABLETOP_OBJECT"], ...] = ()
    evidence_ids: dict[str, tuple[int, ...]] = Field(default_factory=dict)


class SevereLabelError(Answer):
    """Part B."""

    has_severe_label_error: bool = False
    evidence_ids: tuple[int, ...] = ()
    correct_labels: dict[str, Label] = Field(default_factory=dict)


class PhysicalProperties(Answer):
    """Part D."""

    mass_kg: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    has_hinge: bool = False
    hinge_category: str | None = None


class CriterionScore(Answer):
    """One of the four criteria of part E, with the ids it names."""

    score: Score
    bad_geometry_ids: tuple[int, ...] = ()
    graspable_ids: tuple[int, ...] = ()
    ungraspable_ids: tuple[int, ...] = ()


class PerCriterion(Answer):
    """Part E: weights 45, 15, 15 and 25 in a hundred."""

    category_diversity: CriterionScore
    geometric_plausibility: CriterionScore
    graspability: CriterionScore
    layout_clarity: CriterionScore


class Relabelling(Answer):
    """Part F."""

    relabel_name: Label
    distinguishing_phrases: Annotated[tuple[Label, ...], Field(max_length=20)] = ()


class GeneratedTask(Answer):
    """Part G."""

    instruction: Annotated[str, Field(max_length=1000)]
    x_id: int = Field(alias="X_id")
    x_name: Label = Field(alias="X_name")
    y_id: int = Field(alias="Y_id")
    y_name: Label = Field(alias="Y_name")
    relation: Annotated[str, Field(max_length=100)]
    initial_relation_satisfied: bool = False


class JudgeAnswer(Answer):
    """The paper's output schema. Integer ids count the scene's objects from 0; dict keys are those ids as text."""

    usability: Usability
    severe_label_error: SevereLabelError = Field(default_factory=SevereLabelError)
    label_confidence: dict[str, Unit] = Field(default_factory=dict)
    physical_properties: dict[str, PhysicalProperties] = Field(default_factory=dict)
    per_criterion: PerCriterion
    object_relabeling: dict[str, Relabelling] = Field(default_factory=dict)
    final_score: Score
    generated_tasks: Annotated[tuple[GeneratedTask, ...], Field(max_length=500)] = ()


class ObjectAssessment(Answer):
    """Assessment of one object after the checks; object ids are strings (`obj_000`)."""

    object_id: str
    relabel_name: Label
    distinguishing_phrases: tuple[Label, ...] = ()
    label_confidence: Unit
    label_error: bool = False
    corrected_label: str = ""
    mass_kg: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    answered_mass_kg: float | None = None
    """The judge's mass, before it was clipped to what the volume allows [kg]; None if the rules filled it in."""
    mass_clipped: bool = False
    has_hinge: bool = False
    hinge_category: str | None = None
    graspable: bool = False
    bad_geometry: bool = False
    non_tabletop: bool = False
    from_rules: tuple[str, ...] = ()
    """Parts of the answer that lacked this object and were filled in by the rules."""


class TaskAssessment(Answer):
    """Task and its verdict; a refused task stays in the manifest with its reason."""

    task_id: str
    instruction: str
    x_id: str
    y_id: str
    relation: str
    source: str
    accepted: bool
    refusal: str = ""


class JudgeRemark(Answer):
    """Part of an answer that was corrected; tasks have their own `refusal`."""

    code: str
    object_id: str = ""
    detail: str = ""


class AnswerOrigin(Answer):
    """Origin of an answer; empty if no model was asked."""

    model: str = ""
    prompt_sha256: str = ""
    rounds: int = 0
    """1, or 2 where the first answer had to be repaired."""


class Agreement(Answer):
    """Agreement of a judge and the rules on a scene."""

    rules_usable: bool
    rules_score: int
    names_share: Unit
    """Share of the objects that both call by the same noun."""
    mass_ratio: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    """The judge's masses, as clipped, over the rules', median over the objects."""
    rules_tasks: int
    shared_tasks: int
    """Accepted tasks with the same two objects and relation on both sides."""


class Assessment(Answer):
    """Verdict on one scene; `answer_json` keeps the judge's complete answer."""

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
    """None if the rules judged."""
    answer_json: str = ""
