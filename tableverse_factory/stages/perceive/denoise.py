"""Statistical and radius outlier filters on the points of one object (paper section 3.1)."""

import numpy as np
from jaxtyping import Bool
from scipy.spatial import cKDTree

from schemas.geometry import Points

NEIGHBOURS = 16
DEVIATIONS = 2.0
RADIUS_OF_MEDIAN = 2.5
MIN_IN_RADIUS = 6


def find_inlier_points(points: Points) -> Bool[np.ndarray, " n"]:
    """Find points whose mean distance to their neighbours is usual and whose surroundings are not empty.

    The radius that must hold `MIN_IN_RADIUS` others follows the points' density: near and far objects count alike.
    """
    if len(points) <= NEIGHBOURS:
        return np.zeros(len(points), dtype=bool)
    distances, _ = cKDTree(points).query(points, k=NEIGHBOURS + 1)
    mean = distances[:, 1:].mean(axis=1)
    usual = mean <= mean.mean() + DEVIATIONS * mean.std()
    crowd = distances[:, MIN_IN_RADIUS]
    return usual & (crowd <= max(RADIUS_OF_MEDIAN * float(np.median(crowd)), 1e-6))
