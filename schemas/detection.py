"""The paper's detection schema (appendix A): what a Detector answers. Untrusted text until validated here."""

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from schemas.curation import AnswerOrigin
from schemas.identity import clean_label

MAX_DETECTIONS = 200
MAX_COUNT = 100

Label = Annotated[str, Field(max_length=4000), AfterValidator(clean_label)]
Coordinate = Annotated[float, Field(ge=0.0, le=1000.0, allow_inf_nan=False)]
Box = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
"""xmin, ymin, xmax, ymax, normalised to 0–1000 over the picture's width and height."""


class _Answer(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class Detection(_Answer):
    """A regular object, or the table (label `table`, exactly one)."""

    label: Label
    bbox_xyxy: Box
    score: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] = 1.0
    description: Annotated[str, Field(max_length=4000)] = ""
    instance_id: int | None = None
    """Ours, optional: the value of this object's pixels in `masks.png`."""


class Container(_Answer):
    """The outermost part of a composite."""

    label: Label
    bbox: Box
    description: Annotated[str, Field(max_length=4000)] = ""
    instance_id: int | None = None


class Content(_Answer):
    """One representative of the things inside a container, and how many there are."""

    label: Label
    bbox: Box
    count: Annotated[int, Field(ge=1, le=MAX_COUNT)] = 1
    description: Annotated[str, Field(max_length=4000)] = ""
    instance_id: int | None = None


class Composite(_Answer):
    """A container and what fills it."""

    type: Literal["container_fill"] = "container_fill"
    description: Annotated[str, Field(max_length=4000)] = ""
    container: Container
    contents: Annotated[tuple[Content, ...], Field(max_length=MAX_DETECTIONS)] = ()


class Detections(_Answer):
    """A whole answer: every object once, either in `detections` or in `composites`."""

    detections: Annotated[tuple[Detection, ...], Field(max_length=MAX_DETECTIONS)] = ()
    composites: Annotated[tuple[Composite, ...], Field(max_length=MAX_DETECTIONS)] = ()


class DetectionRemark(_Answer):
    """Something that was left out of a model's answer, or put right in it."""

    where: Annotated[str, Field(max_length=200)]
    """Its place in the answer, such as `detections[3]`; empty for the whole of it."""
    label: Annotated[str, Field(max_length=200)] = ""
    rule: Annotated[str, Field(max_length=100)]
    """Stable snake_case code to count by (docs/detector.md)."""
    detail: Annotated[str, Field(max_length=1000)] = ""


class DetectionRecord(_Answer):
    """How a model's answer came about, and what the rules made of it."""

    origin: AnswerOrigin
    answer: Detections
    """What is used: the answer after the rules. As `detections.json` it can be replayed."""
    remarks: tuple[DetectionRemark, ...] = ()
