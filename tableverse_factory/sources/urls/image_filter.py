"""Filter of bare pictures: large enough, sharp, of a usual shape, with contrast, without near duplicates."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from PIL import Image

from schemas.geometry import Picture
from schemas.manifest import ImageRow
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.sources.urls.near_duplicates import find_near_duplicates
from tableverse_factory.sources.urls.phash import compute_phash

WORKING_SIDE_PX = 512  # Longer side at which sharpness is measured: large pictures are shrunk to it, none is enlarged


@dataclass(frozen=True, slots=True)
class FilterCriteria:
    """Criteria for bare pictures; docs/sourcing.md derives the defaults.

    Attributes:
        min_side_px: Least length of the shorter side [px].
        max_aspect: Greatest ratio of the longer to the shorter side.
        min_contrast: Least standard deviation of the grey values, of 255.
        min_sharpness: Least variance of the Laplacian over the variance of the grey values.
        near_bits: Pictures whose hashes differ in at most this many of 64 bits are duplicates; -1 for never.
    """

    min_side_px: int = 256
    max_aspect: float = 3.0
    min_contrast: float = 8.0
    min_sharpness: float = 0.01
    near_bits: int = 6


@dataclass(frozen=True, slots=True)
class ImageStats:
    """Measurements of a picture (units as in `FilterCriteria`)."""

    width: int
    height: int
    contrast: float
    sharpness: float
    phash: int


def measure_image(picture: Picture) -> ImageStats:
    """Measure a picture. Shape (h, w, 3) sRGB, upright."""
    height, width = picture.shape[:2]
    grey = Image.fromarray(picture).convert("L")
    shrink = WORKING_SIDE_PX / max(width, height)
    if shrink < 1:
        size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
        grey = grey.resize(size, Image.Resampling.LANCZOS)
    levels = np.asarray(grey, dtype=np.float32)
    variance = float(levels.var())
    edges = scipy.ndimage.laplace(levels, mode="nearest")
    sharpness = float(edges.var()) / variance if variance > 0 else 0.0
    return ImageStats(width, height, math.sqrt(variance), sharpness, compute_phash(picture))


def find_rejection(stats: ImageStats, criteria: FilterCriteria) -> tuple[str, str] | None:
    """Find code and detail of the first reason against a picture."""
    short, long = sorted((stats.width, stats.height))
    pixels = f"{stats.width} x {stats.height} pixels"
    if short < criteria.min_side_px:
        return "too_small", f"{pixels}: the shorter side has less than {criteria.min_side_px}"
    if long > criteria.max_aspect * short:
        return "odd_shape", f"{pixels}: one side is over {criteria.max_aspect:g} times the other"
    if stats.contrast < criteria.min_contrast:
        spread = f"its grey varies by {stats.contrast:.1f} of 255 around its mean"
        return "uniform", f"{spread}: less than {criteria.min_contrast:g}"
    if stats.sharpness < criteria.min_sharpness:
        return "blurred", f"its sharpness is {stats.sharpness:.4f}: less than {criteria.min_sharpness:g}"
    return None


def filter_rows(
    rows: Sequence[ImageRow], stats: Mapping[str, ImageStats], criteria: FilterCriteria
) -> tuple[ImageRow, ...]:
    """Reject the rows of pictures that fail the criteria."""
    checked = [_apply_criteria(row, stats.get(row.scene_id), criteria) for row in rows]
    remaining = [number for number, row in enumerate(checked) if not row.rejected and row.scene_id in stats]
    if criteria.near_bits < 0:
        return tuple(checked)
    candidates = [stats[checked[number].scene_id] for number in remaining]
    # Among equally large pictures, a known licence wins.
    licensed = [bool(checked[number].licence) for number in remaining]
    ranks = [2 * seen.width * seen.height + known for seen, known in zip(candidates, licensed, strict=True)]
    duplicates = find_near_duplicates([seen.phash for seen in candidates], ranks, criteria.near_bits)
    for number, (kept, bits) in duplicates.items():
        first = checked[remaining[kept]]
        detail = f"{bits} bits from {first.scene_id}, not smaller, at {sanitize_line(first.url or first.uri, 500)}"
        checked[remaining[number]] = _reject(checked[remaining[number]], "near_duplicate_of", detail)
    return tuple(checked)


def _apply_criteria(row: ImageRow, stats: ImageStats | None, criteria: FilterCriteria) -> ImageRow:
    against = None if stats is None or row.rejected else find_rejection(stats, criteria)
    return row if against is None else _reject(row, *against)


def _reject(row: ImageRow, reason: str, detail: str) -> ImageRow:
    return row.model_copy(update={"rejected": reason, "rejected_detail": detail})
