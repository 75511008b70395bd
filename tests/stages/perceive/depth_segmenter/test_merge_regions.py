"""Merging of regions."""

import numpy as np

from schemas.geometry import Camera
from tableverse_factory.stages.perceive.depth_segmenter.surface import (
    compute_surface,
)

CAMERA = Camera(200.0, 200.0, 59.5, 39.5, 120, 80)


def plane_depth(normal, offset, camera=CAMERA):
    """Depth of the plane `normal · x = offset`."""
    v, u = np.indices((camera.height, camera.width), dtype=np.float64)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    return offset / (rays @ np.asarray(normal, dtype=float))


def two_planes(first, second, keep):
    a, b = plane_depth(*first), plane_depth(*second)
    return keep(a, b).astype(np.float32)


def test_a_convex_edge_seen_from_outside_bulges_towards_the_camera():
    near = two_planes(((0.8, 0, 1), 0.8), ((-0.8, 0, 1), 0.8), np.maximum)
    assert near[40, 60] < near[40, 20], "the edge in the middle is nearer than the sides"
    assert compute_surface(near, CAMERA, 0.8).borders[20:60, 20:100].max() < 0.4
