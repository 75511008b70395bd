"""Input features of the learned segmenter, the same in training and in use."""

from typing import Final

import numpy as np
from jaxtyping import Float, Float32
from scipy import ndimage

from schemas.geometry import Mask
from tableverse_factory.stages.perceive.learned.net_format import CHANNELS

MULTIPLE: Final = 16  # height and width of the input are multiples of it
PIXELS: Final = 80_000  # approximate size of the training pictures; larger ones are thinned to it
ALONG_UNIT_M: Final = 0.3
HEIGHT_UNIT_M: Final = 0.15
OFFSET_UNIT_M: Final = 0.1
_BOUND: Final = 4.0


def compute_features(
    points_table: Float[np.ndarray, "h w 3"], valid: Mask, center_xy: Float[np.ndarray, "2"]
) -> Float32[np.ndarray, "7 h w"]:
    """Compute position along the table, height, normal and validity; 0 where there is no reading.

    The points' z is the height above the table plane; `center_xy`, amid the objects, is the origin of positions [m].
    """
    result = np.zeros((CHANNELS, *valid.shape), dtype=np.float32)
    points = points_table.astype(np.float32)
    result[:2] = np.moveaxis((points[..., :2] - center_xy.astype(np.float32)) / ALONG_UNIT_M, -1, 0)
    result[2] = points[..., 2] / HEIGHT_UNIT_M
    np.clip(result[:3], -_BOUND, _BOUND, out=result[:3])
    result[3:6] = np.moveaxis(_compute_normals(points, valid), -1, 0)
    result[6] = 1.0
    result *= valid
    return result


def _compute_normals(points: Float32[np.ndarray, "h w 3"], valid: Mask) -> Float32[np.ndarray, "h w 3"]:
    """Compute normals towards the camera by differences of means over three pixels each way."""
    weight = np.maximum(ndimage.uniform_filter(valid.astype(np.float32), 3), 1e-6)
    smooth = ndimage.uniform_filter(points * valid[..., None], (3, 3, 1)) / weight[..., None]
    padded = np.pad(smooth, ((1, 1), (1, 1), (0, 0)), mode="edge")
    down, right = padded[2:, 1:-1] - padded[:-2, 1:-1], padded[1:-1, 2:] - padded[1:-1, :-2]
    normals = np.cross(down, right)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
