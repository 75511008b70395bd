"""The smallest rectangle around points in a plane."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Frozen
from tableverse_factory.core.errors import GeometryError

Points2 = Float64[np.ndarray, "n 2"]


@dataclass(frozen=True, slots=True, eq=False)
class Rectangle(Frozen):
    """A rectangle in a plane [m], its own axes rotated by `yaw`, in [-pi/4, pi/4) [rad]."""

    center: Float64[np.ndarray, "2"]
    half_size: Float64[np.ndarray, "2"]
    yaw: float

    def distance(self, point: Float64[np.ndarray, "2"]) -> float:
        """Distance of a point outside [m]; 0 within."""
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        offset = np.array([[cos, sin], [-sin, cos]]) @ (point - self.center)
        return float(np.linalg.norm(np.maximum(np.abs(offset) - self.half_size, 0.0)))


def fit_min_rectangle(points: Points2) -> Rectangle:
    """Fit the rectangle of least area around all points (one of its sides lies on an edge of their hull)."""
    try:
        hull = points[ConvexHull(points).vertices]
    except (QhullError, ValueError) as error:
        raise GeometryError(f"{len(points)} points span no area") from error
    edges = np.roll(hull, -1, axis=0) - hull
    angles = np.mod(np.arctan2(edges[:, 1], edges[:, 0]) + np.pi / 4, np.pi / 2) - np.pi / 4
    axes = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    along = hull @ axes.T
    across = hull @ np.stack([-axes[:, 1], axes[:, 0]], axis=0)
    best = int(np.argmin(np.ptp(along, axis=0) * np.ptp(across, axis=0)))
    low = np.array([along[:, best].min(), across[:, best].min()])
    high = np.array([along[:, best].max(), across[:, best].max()])
    u, v = axes[best], np.array([-axes[best, 1], axes[best, 0]])
    middle = (low + high) / 2
    return Rectangle(middle[0] * u + middle[1] * v, (high - low) / 2, float(angles[best]))
