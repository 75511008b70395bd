"""How long the lens of a bare picture was, by its EXIF."""

import math
import struct
import warnings
from typing import Any

from PIL import Image

DIAGONAL_35MM = math.hypot(36.0, 24.0)
"""Of the film that "35 mm equivalent" speaks of [mm]; equivalence is of diagonals (CIPA DCG-001)."""

SHORTEST, LONGEST = 0.2, 50.0
"""Bounds of a believable focal length, in longer sides of the picture: a fisheye and a telescope lie outside."""

MAX_ASPECT_CHANGE = 0.02
_EXIF_IFD = 0x8769
_FOCAL_MM, _FOCAL_35MM = 0x920A, 0xA405
_WIDTH, _HEIGHT = 0xA002, 0xA003
_SENSOR_PER_UNIT, _SENSOR_UNIT = 0xA20E, 0xA210
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


def exif_focal(image: Image.Image) -> float | None:
    """Focal length by the EXIF [px]; None where it says nothing that can be believed of this picture.

    A picture that was cut has another aspect than its camera gave it: then its EXIF is about another picture. One
    that was made smaller is fine.
    """
    tags = _tags(image)
    longer, shorter = max(image.size), min(image.size)
    taken = sorted(number for tag in (_WIDTH, _HEIGHT) if (number := _positive(tags.get(tag))) is not None)
    if len(taken) == 2 and abs(taken[0] / taken[1] - shorter / longer) > MAX_ASPECT_CHANGE * shorter / longer:
        return None
    focal = _by_film(tags, image.size) or _by_sensor(tags, longer, taken)
    return focal if focal is not None and SHORTEST * longer <= focal <= LONGEST * longer else None


def _tags(image: Image.Image) -> dict[int, Any]:
    """What the camera wrote; nothing where that is broken, which says nothing about the pixels."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # Pillow's, about notes that are cut off
            return dict(image.getexif().get_ifd(_EXIF_IFD))
    except (SyntaxError, ValueError, OverflowError, OSError, struct.error):  # each has been seen of Pillow
        return {}


def _by_film(tags: dict[int, Any], size: tuple[int, int]) -> float | None:
    equivalent = _positive(tags.get(_FOCAL_35MM))
    return None if equivalent is None else equivalent * math.hypot(*size) / DIAGONAL_35MM


def _by_sensor(tags: dict[int, Any], longer: int, taken: list[float]) -> float | None:
    """From millimetres and the sensor's pixels per length, at the size that the picture had when it was taken."""
    focal_mm, per_unit = _positive(tags.get(_FOCAL_MM)), _positive(tags.get(_SENSOR_PER_UNIT))
    unit_mm = _UNIT_MM.get(tags.get(_SENSOR_UNIT, 2))
    if focal_mm is None or per_unit is None or unit_mm is None or len(taken) != 2:
        return None
    return focal_mm * per_unit / unit_mm * longer / taken[1]


def _positive(value: Any) -> float | None:
    """A tag's number if it is one: rationals may divide by zero, and anybody may have written text."""
    if isinstance(value, bytes | str | bool) or value is None:
        return None
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0.0 else None
