"""Edges in a picture along the borders of its regions: where depth and picture disagree, the picture tells."""

import numpy as np
from jaxtyping import Float64
from scipy import ndimage
from skimage.color import rgb2lab

from schemas.geometry import IdImage, Mask, Picture

BLUR_PX = 1.0  # of the noise in colours

LabImage = Float64[np.ndarray, "h w 3"]


def convert_to_lab(color: Picture) -> LabImage:
    """Convert a picture to CIELAB, without its noise."""
    return np.asarray(ndimage.gaussian_filter(rgb2lab(color), (BLUR_PX, BLUR_PX, 0.0)))


def measure_color_edges(labels: IdImage, count: int, shown: LabImage, other: Mask) -> Float64[np.ndarray, " count"]:
    """Measure how much the colour changes over the border of each of the labels 1 to `count` with other pixels.

    Returns the median CIELAB difference of each, infinite without a border: that between the nearest pixels which lie
    within either side by more than one pixel.
    """
    numbers = np.arange(1, count + 1)
    sides = ndimage.binary_erosion(labels > 0), ndimage.binary_erosion(other)
    border = (labels > 0) & ndimage.binary_dilation(other)
    if not border.any() or not all(side.any() for side in sides):
        return np.full(count, np.inf)
    within, beyond = (
        shown[tuple(ndimage.distance_transform_edt(~side, return_distances=False, return_indices=True)[:, border])]
        for side in sides
    )
    found = ndimage.median(np.linalg.norm(within - beyond, axis=1), labels[border], numbers)
    return np.where(np.isin(numbers, labels[border]), found, np.inf)
