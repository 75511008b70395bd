"""An observation as points over a table: what every detector and segmenter looks at."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from schemas.geometry import DepthImage, Frozen, Mask
from schemas.observation import Observation
from tableverse_factory.geometry.planes import Plane, Points2

MIN_HEIGHT_M = 0.006
MAX_HEIGHT_M = 0.8


def depth_noise(depth: DepthImage) -> Float64[np.ndarray, "h w"]:
    """Standard deviation of a structured-light sensor's axial noise [m] (Nguyen, Izadi and Lovell 2012)."""
    z = np.asarray(depth, dtype=np.float64)
    return 0.0012 + 0.0019 * (z - 0.4) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class TableView(Frozen):
    """The picture, its points, and the table they stand on.

    Attributes:
        points_camera: Shape (h, w, 3) [m]; the origin where there is no reading.
        valid: Where there is a reading.
        plane: The table plane in the camera frame, its normal upwards.
        heights: Above the table [m]; shape (h, w), 0 where there is no reading.
        on_plane: Pixels that belong to the table plane.
        outline_xy: Convex outline of the visible table-top, in the axes of `axes`, counter-clockwise [m].
        axes: Rows: the table frame's x, y and z as camera directions.
        standing: Pixels of things that stand on the table: above it, over its outline.
    """

    observation: Observation
    points_camera: Float64[np.ndarray, "h w 3"]
    valid: Mask
    plane: Plane
    heights: Float64[np.ndarray, "h w"]
    on_plane: Mask
    outline_xy: Points2
    axes: Float64[np.ndarray, "3 3"]
    standing: Mask

    def xy(self, points_camera: Float64[np.ndarray, "*shape 3"]) -> Float64[np.ndarray, "*shape 2"]:
        """Coordinates along the table, its origin below the camera [m]."""
        along: Float64[np.ndarray, "*shape 2"] = points_camera @ self.axes[:2].T
        return along
