"""Length that is known in a picture, by which the scale of its depth is measured (docs/captures.md)."""

import itertools
import math
from typing import Annotated, Literal, TypeAlias

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from schemas.error_text import describe_validation_error

MAX_CHARS = 1000
MIN_DISTANCE_PX = 4.0
# Longer and shorter side (ISO 216, ANSI Y14.1, ISO 7810 ID-1)
SHEET_SIZES_M = {"a4": (0.297, 0.210), "us_letter": (0.2794, 0.2159), "bank_card": (0.0856, 0.05398)}
PIXEL_STD = 0.001  # standard deviation of a marked pixel, in longer sides of the picture

_Coordinate = Annotated[float, Field(ge=-0.5, le=100_000.0, allow_inf_nan=False)]
Pixel: TypeAlias = tuple[_Coordinate, _Coordinate]
"""Column and row in the upright picture of the file, pixel centres at whole numbers [px]."""


def _check_apart(pixels: tuple[Pixel, ...]) -> tuple[Pixel, ...]:
    if min(math.dist(a, b) for a, b in itertools.combinations(pixels, 2)) < MIN_DISTANCE_PX:
        raise ValueError(f"two of the pixels are less than {MIN_DISTANCE_PX:g} px apart: mark them where they are")
    return pixels


def _check_convex(corners: tuple[Pixel, ...]) -> tuple[Pixel, ...]:
    turns = [
        (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])
        for a, b, c in zip(corners, (*corners[1:], corners[0]), (*corners[2:], *corners[:2]), strict=True)
    ]
    if not (min(turns) > 0.0 or max(turns) < 0.0):
        raise ValueError("the pixels are no corners in their order around a sheet: go around it once")
    return corners


_Ends = Annotated[tuple[Pixel, Pixel], AfterValidator(_check_apart)]
_Corners = Annotated[tuple[Pixel, Pixel, Pixel, Pixel], AfterValidator(_check_apart), AfterValidator(_check_convex)]


class _Known(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class KnownDistance(_Known):
    """Straight distance between the surfaces at two pixels [m]."""

    kind: Literal["distance"]
    length_m: Annotated[float, Field(ge=0.01, le=10.0, allow_inf_nan=False)]
    pixels: _Ends


class KnownSheet(_Known):
    """Flat rectangle of a standard size, by the pixels of its corners around it; rounded ones where the edges meet."""

    kind: Literal["a4", "us_letter", "bank_card"]
    pixels: _Corners

    @property
    def size_m(self) -> tuple[float, float]:
        """Longer and shorter side [m]."""
        return SHEET_SIZES_M[self.kind]


class KnownHeight(_Known):
    """Height of an object over the table [m]; the object by a pixel on it, or by its detector's label."""

    kind: Literal["height"]
    length_m: Annotated[float, Field(ge=0.01, le=2.0, allow_inf_nan=False)]
    pixels: Annotated[tuple[Pixel, ...], Field(max_length=1)] = ()
    label: Annotated[str, Field(max_length=120)] = ""

    @model_validator(mode="after")
    def _check_object(self) -> "KnownHeight":
        if bool(self.pixels) == bool(self.label):
            raise ValueError("name the object by one pixel on it, pixels [[x, y]], or by its label: one of both")
        return self


class KnownCameraHeight(_Known):
    """Height of the camera over the table's plane [m]."""

    kind: Literal["camera_height"]
    length_m: Annotated[float, Field(ge=0.05, le=5.0, allow_inf_nan=False)]
    pixels: tuple[()] = ()


KnownLength: TypeAlias = Annotated[
    KnownDistance | KnownSheet | KnownHeight | KnownCameraHeight, Field(discriminator="kind")
]
KNOWN_LENGTHS = (KnownDistance, KnownSheet, KnownHeight, KnownCameraHeight)

_ADAPTER: TypeAdapter[KnownLength] = TypeAdapter(KnownLength)


def get_pixel_std(sides: tuple[int, ...]) -> float:
    """Get the standard deviation of a pixel that a person marks in a picture of two sides [px]."""
    return max(0.5, PIXEL_STD * max(sides))


def parse_known_length(text: str) -> KnownLength:
    """Parse a known length from JSON; a ValueError names what is wrong, in one line."""
    if len(text) > MAX_CHARS:
        raise ValueError(f"a known length has {len(text)} characters; at most {MAX_CHARS} are read")
    try:
        return _ADAPTER.validate_json(text, strict=True)
    except ValidationError as error:
        raise ValueError(describe_validation_error(error, skipped=1)) from None  # the kind


def encode_known_length(known: KnownLength | None) -> str:
    """Encode a known length as canonical JSON; empty for none."""
    return "" if known is None else known.model_dump_json(exclude_defaults=True)


def _normalize_text(text: str) -> str:
    return encode_known_length(parse_known_length(text)) if text else ""


KnownLengthText = Annotated[str, Field(max_length=MAX_CHARS), AfterValidator(_normalize_text)]
"""A known length as canonical JSON, or empty."""
