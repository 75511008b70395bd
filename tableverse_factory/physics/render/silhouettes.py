"""Silhouettes of the objects of a twin against the masks of its photograph."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from schemas.geometry import IdImage


@dataclass(frozen=True, slots=True)
class Silhouettes:
    """Agreement of two id images of the same size; ids above 0 are objects."""

    ious: Mapping[int, float]  # of each id of either image: pixels in both over those in either
    whole_iou: float  # pixels that both give to the same object over those that either gives to any; 1 of nothing


def compare_silhouettes(masks: IdImage, shown: IdImage) -> Silhouettes:
    """Compare the masks of a photograph with the objects that the twin shows."""
    same = masks == shown
    photographed, drawn, shared = (_count_pixels(its) for its in (masks, shown, masks[same]))
    ious = {
        value: shared.get(value, 0) / (photographed.get(value, 0) + drawn.get(value, 0) - shared.get(value, 0))
        for value in sorted({*photographed, *drawn})
    }
    either = (masks > 0) | (shown > 0)
    return Silhouettes(ious, float(same[either].mean()) if either.any() else 1.0)


def _count_pixels(image: np.ndarray) -> dict[int, int]:
    values, counts = np.unique(image[image > 0], return_counts=True)
    return dict(zip(values.tolist(), counts.tolist(), strict=True))
