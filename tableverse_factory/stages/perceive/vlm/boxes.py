"""Normalisation of the boxes that models write to xmin, ymin, xmax, ymax in 0 to 1000: key, order, unit, corners."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from schemas.detection import Box
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.stages.perceive.vlm.prompt import BoxOrder

# Keys that models use for a box, whatever they were asked; the first two tell their order
KEYS = ("bbox_xyxy", "bbox_yxyx", "bbox", "box_2d", "bbox_2d", "box")

FULL = 1000.0
SLACK = 30.0  # how far a box may reach out of the picture and is clipped; beyond, it is rejected
MAX_FRACTION = 1.05
MIN_SIDE_PX = 3.0
MIN_IN_PIXELS = 2

_SIDES = (("xmin", "ymin", "xmax", "ymax"), ("x1", "y1", "x2", "y2"), ("left", "top", "right", "bottom"))
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?")
_MAX_CHARS = 200
_MAX_MAGNITUDE = 1e6

Corners = tuple[float, float, float, float]  # xmin, ymin, xmax, ymax in the model's own unit
ImageSize = tuple[int, int]  # width and height of the picture sent [px]


class BoxScale(NamedTuple):
    """Factors of x and y to 0 to 1000, and the unit's name."""

    x: float
    y: float
    unit: str


THOUSANDTHS = BoxScale(1.0, 1.0, "thousandths")


def read_corners(entry: Any, order: BoxOrder) -> Corners | None:
    """Read the box of an entry under any of `KEYS`; None where there is none, or it is no four numbers."""
    key = next((name for name in KEYS if entry.get(name) is not None), "") if isinstance(entry, Mapping) else ""
    value = entry[key] if key else entry
    named = _read_named_sides(value)
    if named is not None:
        return named
    numbers = _read_four_numbers(value)
    if numbers is None:
        return None
    a, b, c, d = numbers
    is_yxyx = key == "bbox_yxyx" or (order == "yxyx" and key != "bbox_xyxy")
    return (b, a, d, c) if is_yxyx else (a, b, c, d)


def _read_named_sides(value: Any) -> Corners | None:
    """Read the corners of an object that names its sides, so that no order is needed."""
    for names in _SIDES:
        if isinstance(value, Mapping) and all(name in value for name in names):
            return _to_corners([read_number(value[name]) for name in names])
    return None


def _read_four_numbers(value: Any) -> Corners | None:
    """Read four numbers from a list, two lists of two, a list in a list, or a text such as `<bbox>1 2 3 4</bbox>`."""
    if isinstance(value, str):
        if len(value) > _MAX_CHARS:
            return None
        return _to_corners([float(number) for number in _NUMBER.findall(value)])
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    if not isinstance(value, list):
        return None
    if len(value) == 2 and all(isinstance(point, list) and len(point) == 2 for point in value):
        return _to_corners([read_number(number) for point in value for number in point])
    return _to_corners([read_number(number) for number in value])


def read_number(value: Any) -> float:
    """Read a number, also one written as text; NaN for anything else."""
    if isinstance(value, str) and len(value) < _MAX_CHARS and _NUMBER.fullmatch(value.strip()):
        return float(value)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and abs(value) <= _MAX_MAGNITUDE else math.nan


def _to_corners(numbers: Sequence[float]) -> Corners | None:
    if len(numbers) != 4 or not all(math.isfinite(n) and abs(n) <= _MAX_MAGNITUDE for n in numbers):
        return None
    a, b, c, d = numbers
    return a, b, c, d


def infer_scale(boxes: Sequence[Corners], sent: ImageSize) -> BoxScale:
    """Infer the unit of all boxes of an answer where it is unambiguous; else thousandths, as was asked.

    Fractions: nothing reaches beyond 1, which in thousandths would put the table and everything on it into one corner.
    Pixels: several boxes reach beyond 1000, and all lie within the picture sent.
    """
    if not boxes:
        return THOUSANDTHS
    furthest = [max(box) for box in boxes]
    if max(furthest) <= MAX_FRACTION:
        return BoxScale(FULL, FULL, "fractions")
    beyond = sum(value > FULL + SLACK for value in furthest)
    if beyond >= MIN_IN_PIXELS and all(_is_in_picture(box, sent) for box in boxes):
        x, y = (math.nextafter(FULL / side, 0.0) for side in sent)  # rounded up, a box to the border would be clipped
        return BoxScale(x, y, "pixels")
    if beyond > len(boxes) / 2:
        raise AnswerInvalidError(
            f"boxes reach {max(furthest):.0f}: they must be normalised to 0 to 1000 over the picture's width and height"
        )
    return THOUSANDTHS


def _is_in_picture(box: Corners, size: ImageSize) -> bool:
    return min(box) >= 0 and max(box[0], box[2]) <= size[0] and max(box[1], box[3]) <= size[1]


def normalise_box(corners: Corners, scale: BoxScale, sent: ImageSize) -> tuple[Box | None, str]:
    """Clip the box to the picture and tell what was changed; None and the reason where it is unusable."""
    x0, x1 = sorted((corners[0] * scale.x, corners[2] * scale.x))
    y0, y1 = sorted((corners[1] * scale.y, corners[3] * scale.y))
    if min(x0, y0) < -SLACK or max(x1, y1) > FULL + SLACK:
        return None, f"its box ({x0:.0f}, {y0:.0f}, {x1:.0f}, {y1:.0f}) lies out of the picture"
    done = []
    if corners[0] > corners[2] or corners[1] > corners[3]:
        done.append("corners put in order")
    box = (max(x0, 0.0), max(y0, 0.0), min(x1, FULL), min(y1, FULL))
    if box != (x0, y0, x1, y1):
        done.append("clipped to the picture")
    width, height = (box[2] - box[0]) * sent[0] / FULL, (box[3] - box[1]) * sent[1] / FULL
    if min(width, height) < MIN_SIDE_PX:
        return None, f"its box is {max(width, 0.0):.1f} x {max(height, 0.0):.1f} pixels"
    return box, ", ".join(done)
