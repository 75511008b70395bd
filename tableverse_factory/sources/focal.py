"""Focal lengths: that of a picture from its EXIF data, and the angles that cameras have."""

import math
import struct
import warnings
from dataclasses import dataclass
from typing import Any

from PIL import Image

from schemas.geometry import Camera
from tableverse_factory.core.errors import InputError
from tableverse_factory.geometry.math.camera import compute_field_of_view_deg

DIAGONAL_35MM = math.hypot(36.0, 24.0)  # diagonal of the film of "35 mm equivalent" [mm] (CIPA DCG-001)
SHORTEST, LONGEST = 0.2, 50.0  # plausible focal lengths, in longer sides: fisheyes and telescopes lie outside
FIELD_RANGE_DEG = (1.0, 160.0)  # of a camera without distortion, over the longer side; focal lengths in 0–1 span more
MAX_ASPECT_CHANGE = 0.02
_EXIF_IFD = 0x8769
_FOCAL_MM, _FOCAL_35MM = 0x920A, 0xA405
_WIDTH, _HEIGHT = 0xA002, 0xA003
_SENSOR_PER_UNIT, _SENSOR_UNIT = 0xA20E, 0xA210
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


@dataclass(frozen=True, slots=True)
class ExifFocal:
    """Focal length that the EXIF data gives.

    Attributes:
        px: For the picture's own size [px]; None if there is none that can be believed.
        ignored: What is there and cannot be used, for people; else empty.
    """

    px: float | None = None
    ignored: str = ""


def read_exif_focal(image: Image.Image) -> ExifFocal:
    """Read the focal length from EXIF; one that is implausible, or of a picture cropped since, is ignored."""
    tags = _read_tags(image)
    longer, shorter = max(image.size), min(image.size)
    taken = sorted(number for tag in (_WIDTH, _HEIGHT) if (number := _parse_positive(tags.get(tag))) is not None)
    if not tags.get(_FOCAL_35MM) and tags.get(_FOCAL_MM) is None:  # 0 of 35 mm stands for unknown
        return ExifFocal()
    if len(taken) == 2 and abs(taken[0] / taken[1] - shorter / longer) > MAX_ASPECT_CHANGE * shorter / longer:
        return ExifFocal(ignored="EXIF focal length of a picture that was cropped since")
    equivalent = _parse_positive(tags.get(_FOCAL_35MM))
    from_film = None if equivalent is None else equivalent * math.hypot(*image.size) / DIAGONAL_35MM
    for px in (from_film, _compute_from_sensor(tags, longer, taken)):
        if px is not None and SHORTEST * longer <= px <= LONGEST * longer:
            return ExifFocal(px)
    return ExifFocal(ignored="EXIF focal length that cannot be used")


def check_field_of_view(camera: Camera, name: str) -> None:
    """Raise `bad_intrinsics` unless a camera spans `FIELD_RANGE_DEG`; `name` says where it was given."""
    field, (low, high) = compute_field_of_view_deg(camera), FIELD_RANGE_DEG
    if not low <= field <= high:
        size = f"{camera.width} x {camera.height} pixels"
        given = f"fx = {camera.fx:g} and fy = {camera.fy:g} px for {size} span {field:.4g}°"
        raise InputError(f"{name}: {given}; give pixels, for {low:g}° to {high:g}°", "bad_intrinsics")


def _read_tags(image: Image.Image) -> dict[int, Any]:
    """Read the EXIF tags; empty if they are damaged, which says nothing about the pixels."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # Pillow warns about truncated maker notes
            return dict(image.getexif().get_ifd(_EXIF_IFD))
    except (SyntaxError, ValueError, OverflowError, OSError, struct.error):  # Pillow raises each of them
        return {}


def _compute_from_sensor(tags: dict[int, Any], longer: int, taken: list[float]) -> float | None:
    """Compute from millimetres and the sensor's resolution, at the recorded size of the picture."""
    focal_mm, per_unit = _parse_positive(tags.get(_FOCAL_MM)), _parse_positive(tags.get(_SENSOR_PER_UNIT))
    unit_mm = _UNIT_MM.get(tags.get(_SENSOR_UNIT, 2))
    if focal_mm is None or per_unit is None or unit_mm is None or len(taken) != 2:
        return None
    return focal_mm * per_unit / unit_mm * longer / taken[1]


def _parse_positive(value: Any) -> float | None:
    """Parse an untrusted tag as a positive number; rationals may divide by zero."""
    if isinstance(value, bytes | str | bool) or value is None:
        return None
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0.0 else None
