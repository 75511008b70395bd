"""The table as the simulation has it: a slab whose top is z = 0, wide enough for all that stands on it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Points, Pose, TriangleMesh
from schemas.objects import Table
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.transforms import transform_points

THICKNESS_M = 0.04
OBJECT_MARGIN_M = 0.10
"""A picture shows part of a table: the slab reaches this far beyond every object, whatever part was seen."""


@dataclass(frozen=True, slots=True, eq=False)
class Slab(Frozen):
    """A rectangle on z = 0 in the table frame, the top of a board.

    Attributes:
        center_xy: Its middle [m].
        half_size_xy: Half extents along its own axes [m].
        yaw: Rotation of its own axes about z [rad].
        color: sRGB.
    """

    center_xy: Float64[np.ndarray, "2"]
    half_size_xy: Float64[np.ndarray, "2"]
    yaw: float
    color: tuple[int, int, int]

    def holds(self, points: Points) -> np.ndarray:
        """Which points lie above the rectangle, however high or low. Shape (n,)."""
        inside: np.ndarray = (np.abs(_along(points[:, :2] - self.center_xy, self.yaw)) <= self.half_size_xy).all(axis=1)
        return inside


def slab_under(table: Table, meshes: Sequence[TriangleMesh], poses: Sequence[Pose], scales: Sequence[float]) -> Slab:
    """The table's rectangle, widened until every object stands `OBJECT_MARGIN_M` inside its edges."""
    low, high = -table.half_size_xy, np.array(table.half_size_xy)
    for mesh, pose, scale in zip(meshes, poses, scales, strict=True):
        corners = transform_points(pose, _box_corners(mesh), scale)[:, :2]
        along = _along(corners - table.center_xy, table.yaw)
        low = np.minimum(low, along.min(axis=0) - OBJECT_MARGIN_M)
        high = np.maximum(high, along.max(axis=0) + OBJECT_MARGIN_M)
    middle = _along(((low + high) / 2)[None], -table.yaw)[0]
    return Slab(table.center_xy + middle, (high - low) / 2, table.yaw, table.color)


def _along(points_xy: Float64[np.ndarray, "n 2"], yaw: float) -> Float64[np.ndarray, "n 2"]:
    c, s = np.cos(yaw), np.sin(yaw)
    turned: Float64[np.ndarray, "n 2"] = points_xy @ np.array([[c, -s], [s, c]])
    return turned


def _box_corners(mesh: TriangleMesh) -> Points:
    low, high = aabb(mesh.vertices)
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
