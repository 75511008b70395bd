"""Arrangement of dense clutter: groups are pushed towards the middle of the table until they nearly touch."""

import numpy as np
from jaxtyping import Float64
from scipy.spatial import ConvexHull

from schemas.geometry import Pose
from tableverse_factory.geometry.math.transforms import compose_poses, quaternion_about_z
from tableverse_factory.sources.synthetic.recipes import PlacedModel, make_group

Polygon = Float64[np.ndarray, "k 2"]

MIN_OBJECTS, MAX_OBJECTS = 5, 12
MAX_RADIUS_M = 0.34
STEP_M = 0.006
TOUCHING_M = 0.0015
WAYS_IN = 3


def arrange_groups(rng: np.random.Generator) -> list[PlacedModel]:
    """Arrange five to twelve objects about the origin of the table frame, not overlapping and not yet settled."""
    wanted = int(rng.integers(MIN_OBJECTS, MAX_OBJECTS + 1))
    placed: list[PlacedModel] = []
    footprints: list[Polygon] = []
    while len(placed) < wanted:
        group = make_group(rng)
        if len(placed) + len(group) > MAX_OBJECTS:
            continue
        group = _move_group(group, np.zeros(2), rng.uniform(0.0, 2 * np.pi))
        footprint = _find_footprint(group)
        gap = TOUCHING_M if rng.random() < 0.4 else rng.uniform(0.004, 0.03)
        offsets = [_push_in(footprint, footprints, azimuth, gap) for azimuth in rng.uniform(0.0, 2 * np.pi, WAYS_IN)]
        offset = min(offsets, key=lambda moved: _measure_reach(footprint + moved))
        if _measure_reach(footprint + offset) > MAX_RADIUS_M:
            wanted -= 1  # the table is full; a smaller scene rather than a scattered one
            continue
        placed += _move_group(group, offset, 0.0)
        footprints.append(footprint + offset)
    return placed


def _measure_reach(footprint: Polygon) -> float:
    return float(np.linalg.norm(footprint, axis=1).max())


def _move_group(group: list[PlacedModel], offset: Float64[np.ndarray, "2"], yaw: float) -> list[PlacedModel]:
    motion = Pose(np.array([offset[0], offset[1], 0.0]), quaternion_about_z(yaw))
    return [PlacedModel(item.model, compose_poses(motion, item.pose)) for item in group]


def _find_footprint(group: list[PlacedModel]) -> Polygon:
    points = np.concatenate([item.vertices()[:, :2] for item in group])
    return points[ConvexHull(points).vertices]


def _push_in(footprint: Polygon, others: list[Polygon], azimuth: float, gap: float) -> Float64[np.ndarray, "2"]:
    """Find the offset at which a footprint, pushed along a ray towards the middle, has to stop."""
    direction = np.array([np.cos(azimuth), np.sin(azimuth)])
    distance = 2 * MAX_RADIUS_M if others else 0.0
    start = footprint - footprint.mean(axis=0)
    while distance > 0.0:
        candidate = start + (distance - STEP_M) * direction
        if any(_is_closer(candidate, other, gap) for other in others):
            break
        distance -= STEP_M
    return distance * direction - footprint.mean(axis=0)


def _is_closer(a: Polygon, b: Polygon, gap: float) -> bool:
    """Check whether two convex polygons are closer than `gap` (separating axes)."""
    for polygon in (a, b):
        edges = np.roll(polygon, -1, axis=0) - polygon
        normals = np.column_stack([edges[:, 1], -edges[:, 0]]) / np.linalg.norm(edges, axis=1, keepdims=True)
        along_a, along_b = normals @ a.T, normals @ b.T
        apart = np.maximum(along_b.min(axis=1) - along_a.max(axis=1), along_a.min(axis=1) - along_b.max(axis=1))
        if apart.max() >= gap:
            return False
    return True
