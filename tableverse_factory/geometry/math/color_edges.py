"""Edges of a picture along the borders of its regions, which tell where errors of the depth do not."""

import numpy as np
from jaxtyping import Float64, Int64
from scipy import ndimage
from skimage.color import rgb2lab

from schemas.geometry import IdImage, Mask, Picture

FAINT_EDGE = 3.0  # median change of colour up to which a border shows no edge, in CIELAB: 1.0 to 2.8 of smeared depth
_BLUR_PX = 1.0  # standard deviation
_NEAR_PX = 3.0

LabImage = Float64[np.ndarray, "h w 3"]


def blur_to_lab(color: Picture) -> LabImage:
    """Convert a picture to CIELAB, blurred by a pixel, so that noise makes no edges. Shape (h, w, 3)."""
    return np.asarray(ndimage.gaussian_filter(rgb2lab(color), (_BLUR_PX, _BLUR_PX, 0.0)))


def measure_color_edges(
    labels: IdImage | Int64[np.ndarray, "h w"], count: int, lab: LabImage, other: Mask
) -> Float64[np.ndarray, " count"]:
    """Measure how much the colour changes from each of the regions 1 to `count` to other pixels that it borders on.

    Returns the median difference in CIELAB, between the nearest pixels that lie within either side by more than one
    pixel; NaN for a region without such a border, or too thin. `labels` and `other`, shape (h, w), do not overlap.
    """
    one = np.ones((3, 3))
    border = (labels > 0) & ndimage.binary_dilation(other)
    within = (labels > 0) & (
        ndimage.grey_erosion(labels, footprint=one) == ndimage.grey_dilation(labels, footprint=one)
    )
    beyond = ndimage.binary_erosion(other)
    if not (border.any() and within.any() and beyond.any()):
        return np.full(count, np.nan)
    own, inner = _find_nearest(within, border)
    far, outer = _find_nearest(beyond, border)
    of = labels[border]
    known = (own <= _NEAR_PX) & (far <= _NEAR_PX) & (labels[inner] == of)
    change = np.linalg.norm(lab[inner] - lab[outer], axis=1)[known]
    return np.array(
        [np.median(change[of[known] == k]) if (of[known] == k).any() else np.nan for k in range(1, count + 1)]
    )


def _find_nearest(
    pixels: Mask, border: Mask
) -> tuple[Float64[np.ndarray, " n"], tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]]:
    """Find the nearest of some pixels from each of a border: the distance [px], and its row and column."""
    away, (row, column) = ndimage.distance_transform_edt(~pixels, return_indices=True)
    return away[border], (row[border], column[border])
