"""Distances of points to a surface."""

import numpy as np
import pytest
import trimesh

from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.mesh.surface_samples import (
    find_largest_distance_to_surface,
    measure_distance_to_surface,
)


@pytest.mark.parametrize("spread", [0.0, 1e-9, 0.01, 1.0])
def test_largest_distance_is_that_of_all_points(spread: float) -> None:
    """Though most points are not measured: near the surface, on it, and all at one distance."""
    mesh = from_trimesh(trimesh.creation.icosphere(3))
    rng = np.random.default_rng(3)
    away = rng.normal(size=(3000, 3))
    points = away / np.linalg.norm(away, axis=1, keepdims=True) * (1.1 + spread * rng.random((3000, 1)))
    largest = find_largest_distance_to_surface(points, mesh, 5000)
    assert largest == pytest.approx(measure_distance_to_surface(points, mesh, 5000).max(), rel=1e-12)
