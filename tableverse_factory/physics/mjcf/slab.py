"""The simulated table: a slab whose top is z = 0, wide enough for all objects on it."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Points, Pose, TriangleMesh
from schemas.objects import Table
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.transforms import transform_points

THICKNESS_M = 0.04
OBJECT_MARGIN_M = 0.10  # the slab reaches this far beyond every object, as a picture may show only part of a table


@dataclass(frozen=True, slots=True, eq=False)
class Slab(Frozen):
    """A rectangle on z = 0 in the table frame [m], the top of a board, its own axes turned about z by `yaw` [rad]."""

    center_xy: Float64[np.ndarray, "2"]
    half_size_xy: Float64[np.ndarray, "2"]
    yaw: float
    color: tuple[int, int, int]

    def holds(self, points: Points) -> np.ndarray:
        """Whether each point lies over or under the rectangle. Shape (n,)."""
        return (np.abs(_rotate_to_slab(points[:, :2] - self.center_xy, self.yaw)) <= self.half_size_xy).all(axis=1)

    def to_table(self, along: Float64[np.ndarray, "n 2"]) -> Points:
        """Points of the top in the table frame, from coordinates along the slab's own axes from its middle [m]."""
        return np.column_stack([_rotate_to_slab(along, -self.yaw) + self.center_xy, np.zeros(len(along))])


def fit_slab(table: Table, meshes: Sequence[TriangleMesh], poses: Sequence[Pose], scales: Sequence[float]) -> Slab:
    """Widen the table's rectangle until every object stands `OBJECT_MARGIN_M` inside its edges."""
    low, high = -table.half_size_xy, np.array(table.half_size_xy)
    for mesh, pose, scale in zip(meshes, poses, scales, strict=True):
        sides = np.stack(aabb(mesh.vertices), axis=1)  # lowest and highest coordinate along each axis, (3, 2)
        corners = np.array(list(product(*sides)))
        along = _rotate_to_slab(transform_points(pose, corners, scale)[:, :2] - table.center_xy, table.yaw)
        low = np.minimum(low, along.min(axis=0) - OBJECT_MARGIN_M)
        high = np.maximum(high, along.max(axis=0) + OBJECT_MARGIN_M)
    middle = _rotate_to_slab(((low + high) / 2)[None], -table.yaw)[0]
    return Slab(table.center_xy + middle, (high - low) / 2, table.yaw, table.color)


def _rotate_to_slab(points_xy: Float64[np.ndarray, "n 2"], yaw: float) -> Float64[np.ndarray, "n 2"]:
    c, s = np.cos(yaw), np.sin(yaw)
    return points_xy @ np.array([[c, -s], [s, c]])
