"""Pixels whose reading a sensor lost, judged by their colour: more of the object, or what lies past it."""

import numpy as np
from jaxtyping import Float64
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.color import rgb2lab

from schemas.geometry import Mask, Picture

SAMPLES = 400
NEAR = 12.0
"""Colours within this distance in CIELAB are alike."""
RARITY = 4.0
"""A colour is of what lies past the object where it is so many times as frequent there, or unknown to the object."""
INSET_PX = 2


def find_foreign_colors(color: Picture, own: Mask, past: Mask, asked: Mask) -> Mask:
    """Which of the pixels `asked` about are of no colour that the object has, or of one far more usual beside it.

    Sensors lose what is black, shiny or at a steep step, on the object and beside it; the picture knows more.
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
    """Share of the known colours that are like each of `colors`."""
    sample = known[:: max(1, -(-len(known) // SAMPLES))]
    if len(sample) == 0:
        return np.zeros(len(colors))
    counts: Float64[np.ndarray, " n"] = cKDTree(sample).query_ball_point(colors, NEAR, return_length=True)
    return counts / len(sample)
