"""An observation as points over a table: what every detector and segmenter looks at."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from schemas.geometry import Frozen, Mask
from schemas.observation import Observation
from tableverse_factory.geometry.planes import Plane, Points2


def depth_noise(depth: Float[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    """Standard deviation of a structured-light sensor's axial noise [m] (Nguyen, Izadi and Lovell 2012)."""
    z = np.asarray(depth, dtype=np.float64)
    noise: Float64[np.ndarray, "*shape"] = 0.0012 + 0.0019 * (z - 0.4) ** 2
    return noise


@dataclass(frozen=True, slots=True, eq=False)
class TableView(Frozen):
    """The picture, its points, and the table they stand on.

    Attributes:
        points_camera: Shape (h, w, 3) [m]; the origin where there is no reading.
        valid: Where there is a reading.
        plane: The table plane in the camera frame, its normal upwards.
        axes: Rows: the table frame's x, y and z as camera directions.
        outline_xy: Convex outline of the visible table-top, counter-clockwise, see `xy` [m].
        heights: Above the plane [m]; shape (h, w), 0 where there is no reading.
        on_plane: Pixels of the table-top itself.
        raised: Pixels clearly above the table-top, over it or not far beside it.
    """

    observation: Observation
    points_camera: Float64[np.ndarray, "h w 3"]
    valid: Mask
    plane: Plane
    axes: Float64[np.ndarray, "3 3"]
    outline_xy: Points2
    heights: Float64[np.ndarray, "h w"]
    on_plane: Mask
    raised: Mask

    def xy(self, points_camera: Float64[np.ndarray, "*shape 3"]) -> Float64[np.ndarray, "*shape 2"]:
        """Coordinates along the table, their origin below the camera [m]."""
        along: Float64[np.ndarray, "*shape 2"] = points_camera @ self.axes[:2].T
        return along
