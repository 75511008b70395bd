"""Colour model of an object against its background, for pixels without a reading."""

import numpy as np
from jaxtyping import Float64
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.color import rgb2lab

from schemas.geometry import Mask, Picture

SAMPLES = 400
NEAR = 12.0
"""Distance in CIELAB within which colours are alike."""
RARITY = 4.0
"""Ratio of frequencies from which a colour is the background's; so is one that the object lacks."""
INSET_PX = 2


def find_foreign_colors(color: Picture, own: Mask, past: Mask, asked: Mask) -> Mask:
    """Find the `asked` pixels whose colour the object lacks, or is far more frequent in the background.

    Sensors lose black and shiny surfaces and steep steps, on the object and beside it; the colour still tells.
    """
    answer = np.zeros(own.shape, dtype=bool)
    core = ndimage.binary_erosion(own, iterations=INSET_PX)
    if not asked.any() or not core.any():
        return answer
    shown = rgb2lab(color)
    on, off = compute_color_share(shown[asked], shown[core]), compute_color_share(shown[asked], shown[past])
    answer[asked] = (on == 0.0) | (RARITY * on < off)
    return answer


def compute_color_share(
    colors: Float64[np.ndarray, "n 3"], known: Float64[np.ndarray, "m 3"]
) -> Float64[np.ndarray, " n"]:
    """Compute the share of the known colours that are like each of `colors`."""
    sample = known[:: max(1, -(-len(known) // SAMPLES))]
    if len(sample) == 0:
        return np.zeros(len(colors))
    counts: Float64[np.ndarray, " n"] = cKDTree(sample).query_ball_point(colors, NEAR, return_length=True)
    return counts / len(sample)
