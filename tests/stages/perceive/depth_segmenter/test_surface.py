"""Normals and borders of a surface, against geometry done on paper."""

import numpy as np
import pytest

from schemas.geometry import Camera
from tableverse_factory.stages.perceive.depth_segmenter.surface import (
    compute_surface,
    fit_normals,
    shift_image,
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


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.3, 0.2, 1), (0, 1, 0.8)])
def test_normals_of_a_plane_are_exact_up_to_the_border(normal):
    unit = -np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    depth = plane_depth(normal, 0.8)
    assert depth.min() > 0
    normals = fit_normals(depth, CAMERA, 4, np.full(depth.shape, 1.0))
    np.testing.assert_allclose(normals, np.broadcast_to(unit, normals.shape), atol=1e-4)


def test_concave_creases_and_steps_are_borders_and_convex_edges_are_not():
    roof = ((0.8, 0, 1), 0.8), ((-0.8, 0, 1), 0.8)
    middle = (slice(20, 60), slice(57, 63))
    edge = compute_surface(two_planes(*roof, np.maximum), CAMERA, 0.8).borders[middle]
    crease = compute_surface(two_planes(*roof, np.minimum), CAMERA, 0.8).borders[middle]
    if edge.max() > crease.max():
        edge, crease = crease, edge
    assert edge.max() < 0.4
    assert crease.max(axis=1).min() > 1.0
    step = np.where(np.arange(120) < 60, 0.8, 0.85) * np.ones((80, 1))
    borders = compute_surface(step.astype(np.float32), CAMERA, 0.8).borders
    assert borders[20:60, 58:62].max(axis=1).min() > 1.0
    assert borders[20:60, :50].max() < 0.1


def test_shifting_looks_ahead_and_fills_with_zero():
    image = np.arange(12).reshape(3, 4)
    assert shift_image(image, 1, -1).tolist() == [[0, 4, 5, 6], [0, 8, 9, 10], [0, 0, 0, 0]]
    assert not shift_image(image, 5, 0).any()
