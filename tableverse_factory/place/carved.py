"""The embedded default MeshModel: a height field over the footprint, carved by the space seen empty."""

import numpy as np
from jaxtyping import Float64
from scipy import ndimage

from schemas.geometry import Points, Pose
from tableverse_factory.geometry.rectangle import smallest_rectangle
from tableverse_factory.geometry.transforms import inverse, quaternion_about_z, transform_points
from tableverse_factory.geometry.volume import (
    Grid,
    from_manifold,
    grid_over,
    largest_part,
    simplified,
    solid_surface,
    to_manifold,
)
from tableverse_factory.place.completion import Completion
from tableverse_factory.place.sighting import Sighting, emptiness

CELLS_ON_LONGEST_SIDE = 56
CELL_RANGE_M = (0.0015, 0.006)
MIN_THICKNESS_M = 0.003
MAX_FACES = 3000


def complete_carved(sighting: Sighting) -> Completion:
    """The height field of the observed points down to the support, without the space seen empty."""
    pose, low, high = own_frame(sighting)
    cell = float(np.clip((high - low).max() / CELLS_ON_LONGEST_SIDE, *CELL_RANGE_M))
    grid = grid_over(low - cell, high + cell, cell)
    field = _height_field(sighting, pose, grid)
    points = transform_points(pose, grid.points())
    field = np.minimum(field, emptiness(sighting, points).reshape(grid.shape))
    solid = largest_part(to_manifold(solid_surface(field, grid)))
    mesh = from_manifold(simplified(solid, MAX_FACES, 0.1 * cell))
    return Completion(mesh, pose, "carved")


def own_frame(sighting: Sighting) -> tuple[Pose, Points, Points]:
    """The object's own upright frame with the yaw of its smallest rectangle, and its bounds in that frame [m].

    Raises:
        GeometryError: if the points span no area.
    """
    rectangle = smallest_rectangle(sighting.points[:, :2])
    top = max(float(np.quantile(sighting.points[:, 2], 0.995)), sighting.support_z + MIN_THICKNESS_M)
    height = top - sighting.support_z
    center = np.array([*rectangle.center, sighting.support_z + height / 2])
    half = np.array([*rectangle.half_size, height / 2])
    return Pose(center, quaternion_about_z(rectangle.yaw)), -half, half


def _height_field(sighting: Sighting, pose: Pose, grid: Grid) -> Float64[np.ndarray, "nx ny nz"]:
    """Signed distance to the solid below the observed points, down to the support [m]."""
    local = transform_points(inverse(pose), sighting.points)
    z = grid.axes()[2]
    column = np.rint((local[:, :2] - grid.origin[:2]) / grid.cell).astype(int)
    column = np.clip(column, 0, np.array(grid.shape[:2]) - 1)
    height = np.full(grid.shape[:2], -np.inf)
    np.maximum.at(height, (column[:, 0], column[:, 1]), local[:, 2])
    seen = np.isfinite(height)
    closed = ndimage.binary_closing(np.pad(seen, 3), iterations=2)[3:-3, 3:-3] | seen
    nearest = ndimage.distance_transform_edt(~seen, return_distances=False, return_indices=True)
    height = height[nearest[0], nearest[1]]
    inside = ndimage.distance_transform_edt(np.pad(closed, 1))[1:-1, 1:-1]
    outside = ndimage.distance_transform_edt(~closed)
    footprint = np.where(closed, inside - 0.5, 0.5 - outside) * grid.cell
    bottom = sighting.support_z - pose.position[2]
    top = np.maximum(height, bottom + MIN_THICKNESS_M)
    below_top = top[:, :, None] - z[None, None, :]
    above_bottom = (z - bottom)[None, None, :]
    field: Float64[np.ndarray, "nx ny nz"] = np.minimum(np.minimum(below_top, above_bottom), footprint[:, :, None])
    return field
