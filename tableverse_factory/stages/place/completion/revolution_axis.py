"""Axes of revolution from points and normals.

All normals of a surface of revolution meet its axis. With Plücker coordinates that is linear in the axis
(Pottmann and Wallner, Computational Line Geometry, 2001, chapter 6).
"""

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Matrix3, Points, Pose, Vector3
from tableverse_factory.geometry.math.transforms import (
    invert_pose,
    quaternion_from_matrix,
    rotation_matrix,
    transform_points,
)
from tableverse_factory.stages.place.completion.nelder_mead import minimize_cost
from tableverse_factory.stages.place.view.object_view import ObjectView

FIT_POINTS = 1500
SLICES = 24
WORST_SPREAD_M = 0.01
UPRIGHT_COS = 0.998
KEPT_SHARE = 0.8  # share of the points that has to agree: the rest may be a handle


def propose_axes(view: ObjectView) -> list[tuple[Pose, float]]:
    """Propose frames with z along a possible axis: upright, lying along the object, and by the normals.

    Each comes with the mean spread of the points' distances from the axis within slices across it [m].
    """
    step = max(1, len(view.points) // FIT_POINTS)
    points, normals = view.points[::step], view.normals[::step]
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    long = np.linalg.eigh(flat.T @ flat)[1][:, 1]
    directions = [np.array([0.0, 0.0, 1.0]), np.array([*long, 0.0])]
    free = _fit_normal_line(points, normals)
    if free is not None and abs(free[2]) < UPRIGHT_COS:
        directions.append(free)
    return [_refine_axis(points, normals, _fit_axis_position(points, normals, direction)) for direction in directions]


def _fit_normal_line(points: Points, normals: Points) -> Vector3 | None:
    """Fit the direction of the line that all normals meet, outliers weighted down; None where it is undecided."""
    middle = points.mean(axis=0)
    size = float(np.abs(points - middle).max())
    rows = np.concatenate([np.cross((points - middle) / size, normals), normals], axis=1)
    weight = np.ones(len(rows))
    direction: Vector3 | None = None
    for _ in range(4):
        values, vectors = np.linalg.eigh((rows * weight[:, None]).T @ rows)
        line = vectors[:, 0]
        length = float(np.linalg.norm(line[:3]))
        if length < 0.05 or values[1] < 1.5 * values[0]:
            return None
        direction = line[:3] / length
        weight = 1.0 / (0.02 + np.abs(rows @ line) / length)
    return direction


def _fit_axis_position(points: Points, normals: Points, direction: Vector3) -> Pose:
    """Fit the line of this direction that the normals meet best (least squares, outliers weighted down)."""
    frame = _build_frame(points.mean(axis=0), direction)
    rotation = rotation_matrix(frame.quaternion_wxyz)
    local, turned = ((points - frame.position) @ rotation)[:, :2], (normals @ rotation)[:, :2]
    rows = np.stack([turned[:, 1], -turned[:, 0]], axis=1)
    right = (rows * local).sum(axis=1)
    weight = np.ones(len(rows))
    # Without slanting normals (a flat top seen from above) the middle of the points is the best guess.
    anchor = 1e-3 * len(rows) * np.eye(2)
    center = np.zeros(2)
    for _ in range(5):
        weighted = rows * weight[:, None]
        center = np.linalg.solve(weighted.T @ rows + anchor, weighted.T @ right)
        weight = 0.003 / (0.003 + np.abs(rows @ center - right))
    return _shift_axis(frame, center)


def _refine_axis(points: Points, normals: Points, axis: Pose) -> tuple[Pose, float]:
    """Move the axis sideways until the points of each slice lie at one distance from it; return the spread left [m]."""
    local = transform_points(invert_pose(axis), points)
    turned = normals @ rotation_matrix(axis.quaternion_wxyz)
    side = np.linalg.norm(turned[:, :2], axis=1) > 0.5
    if side.sum() < 50:
        return axis, 0.0
    (x, y, z), (towards_x, towards_y, _) = np.ascontiguousarray(local[side].T), np.ascontiguousarray(turned[side].T)
    low, high = z.min(), z.max()
    slices = np.minimum(((z - low) / max(high - low, 1e-6) * SLICES).astype(int), SLICES - 1)

    def spread(center: Float64[np.ndarray, "2"]) -> float:
        across_x, across_y = x - center[0], y - center[1]
        distance = np.sqrt(across_x**2 + across_y**2)
        outward = across_x * towards_x + across_y * towards_y > 0.0
        group = 2 * slices + outward
        counts = np.maximum(np.bincount(group, minlength=2 * SLICES), 1)
        means = np.bincount(group, distance, minlength=2 * SLICES) / counts
        gap = np.sort(np.minimum(np.abs(distance - means[group]), WORST_SPREAD_M))
        return float(gap[: int(KEPT_SHARE * len(gap))].mean())

    center = minimize_cost(spread, np.zeros(2), np.full(2, 0.006), 80, xatol=1e-4, fatol=1e-7)
    return _shift_axis(axis, center), spread(center)


def _shift_axis(axis: Pose, center: Float64[np.ndarray, "2"]) -> Pose:
    return Pose(transform_points(axis, np.array([[*center, 0.0]]))[0], axis.quaternion_wxyz)


def _build_frame(origin: Vector3, direction: Vector3) -> Pose:
    """Build a frame with z along `direction`, upward, and x horizontal."""
    z = direction if direction[2] >= 0.0 else -direction
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(x) < 1e-9 else x / np.linalg.norm(x)
    rotation: Matrix3 = np.stack([x, np.cross(z, x), z], axis=1)
    return Pose(origin, quaternion_from_matrix(rotation))
