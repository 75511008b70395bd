"""Local width of a flat shape."""

import numpy as np
from jaxtyping import Float64
from scipy import ndimage

Cells = Float64[np.ndarray, "nx ny"]

LEVELS = 12


def compute_half_width(inside: Cells) -> Cells:
    """Compute the radius of the largest disc within the shape that covers each cell.

    Args:
        inside: Distance of each cell to the shape's border, 0 outside [cells].
    """
    result = inside.copy()
    for radius in np.linspace(0.0, float(inside.max()), LEVELS)[1:]:
        covered = ndimage.distance_transform_edt(inside < radius) < radius
        result = np.maximum(result, np.where(covered, radius, 0.0))
    return result
