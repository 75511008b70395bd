"""The paper's detection schema (appendix A), the answer of a detector; untrusted until validated here."""

from typing import Annotated, Literal

from pydantic import Field

from schemas.curation import Answer, AnswerOrigin, Label

MAX_DETECTIONS = 200
MAX_COUNT = 100

Coordinate = Annotated[float, Field(ge=0.0, le=1000.0, allow_inf_nan=False)]
Box = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
"""xmin, ymin, xmax, ymax, normalised to 0–1000 over the picture's width and height."""


class Detection(Answer):
    """Regular object, or the table (label `table`, exactly one)."""

    label: Label
    bbox_xyxy: Box
    score: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] = 1.0
    description: Annotated[str, Field(max_length=4000)] = ""
    instance_id: int | None = None
    """Our extension, optional: the value of this object's pixels in `masks.png`."""


class Container(Answer):
    """Outermost part of a composite."""

    label: Label
    bbox: Box
    description: Annotated[str, Field(max_length=4000)] = ""
    instance_id: int | None = None


class Content(Answer):
    """Representative of the objects inside a container, and their number."""

    label: Label
    bbox: Box
    count: Annotated[int, Field(ge=1, le=MAX_COUNT)] = 1
    description: Annotated[str, Field(max_length=4000)] = ""
    instance_id: int | None = None


class Composite(Answer):
    """Container and its contents."""

    type: Literal["container_fill"] = "container_fill"
    description: Annotated[str, Field(max_length=4000)] = ""
    container: Container
    contents: Annotated[tuple[Content, ...], Field(max_length=MAX_DETECTIONS)] = ()


class Detections(Answer):
    """Complete answer: every object once, either in `detections` or in `composites`."""

    detections: Annotated[tuple[Detection, ...], Field(max_length=MAX_DETECTIONS)] = ()
    composites: Annotated[tuple[Composite, ...], Field(max_length=MAX_DETECTIONS)] = ()


class DetectionRemark(Answer):
    """Part of a model's answer that was left out or corrected."""

    where: Annotated[str, Field(max_length=200)]
    """Its place in the answer, such as `detections[3]`; empty for the whole of it."""
    label: Annotated[str, Field(max_length=200)] = ""
    rule: Annotated[str, Field(max_length=100)]
    """Stable snake_case code to count by (docs/detector.md)."""
    detail: Annotated[str, Field(max_length=1000)] = ""


class DetectionRecord(Answer):
    """Origin of a model's answer, and what the rules made of it."""

    origin: AnswerOrigin
    answer: Detections
    """The answer after the rules, which is used. As `detections.json` it can be replayed."""
    remarks: tuple[DetectionRemark, ...] = ()
