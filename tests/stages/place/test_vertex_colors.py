"""Which points count as inside of a vessel, so that they take colours from its inside."""

from collections.abc import Callable

import numpy as np
import pytest
from manifold3d import Manifold

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene
from tableverse_factory.geometry.mesh.voxel_solids import from_manifold, to_manifold
from tableverse_factory.stages.place.vertex_colors import (
    INSIDE_M,
    _compute_area_vectors,
    _compute_vertex_normals,
    _measure_inside,
    _measure_inside_of_vertices,
)


def build_cup() -> TriangleMesh:
    return from_manifold(Manifold.cylinder(0.1, 0.04) - Manifold.cylinder(0.1, 0.036).translate((0.0, 0.0, 0.004)))


def build_lidded_cup() -> TriangleMesh:
    return from_manifold(to_manifold(build_cup()) + Manifold.cylinder(0.004, 0.04).translate((0.0, 0.0, 0.1)))


def build_trough() -> TriangleMesh:
    """Build a bottom with two walls, open at both ends."""
    whole, hollow = (Manifold.cube(size, True) for size in ((0.2, 0.08, 0.1), (0.3, 0.072, 0.1)))
    return from_manifold(whole.translate((0.0, 0.0, 0.05)) - hollow.translate((0.0, 0.0, 0.054)))


@pytest.mark.parametrize(
    ("build", "point", "normal", "inside"),
    [
        (build_cup, (0.0, 0.0, 0.004), (0.0, 0.0, 1.0), 1.0),
        (build_cup, (0.036, 0.0, 0.05), (-1.0, 0.0, 0.0), 1.0),
        (build_cup, (0.04, 0.0, 0.05), (1.0, 0.0, 0.0), 0.0),
        (build_cup, (0.0365, 0.0, 0.05), (1.0, 0.0, 0.0), 0.0),
        (build_cup, (0.036, 0.0, 0.1), (-0.7, 0.0, 0.7), 0.5),
        (build_lidded_cup, (0.0, 0.0, 0.004), (0.0, 0.0, 1.0), 0.0),
        (build_trough, (0.0, 0.0, 0.004), (0.0, 0.0, 1.0), 0.0),
    ],
    ids=["floor", "inner wall", "outer wall", "noise within the wall", "rim", "under a lid", "between two walls"],
)
def test_inside_is_what_walls_surround_and_nothing_covers(
    build: Callable[[], TriangleMesh], point: tuple[float, ...], normal: tuple[float, ...], inside: float
) -> None:
    scene = make_raycasting_scene(build())
    assert _measure_inside(scene, np.array([point]), np.array([normal])) == pytest.approx([inside * INSIDE_M])


def test_the_edge_of_a_floor_is_inside_though_the_wall_leans_over_it() -> None:
    hollow = Manifold.cylinder(0.1, 0.036, 0.034, 40).translate((0.0, 0.0, 0.004))
    cup = from_manifold(Manifold.cylinder(0.1, 0.04, circular_segments=40) - hollow)
    faced = _compute_area_vectors(cup)
    inside = _measure_inside_of_vertices(make_raycasting_scene(cup), cup, faced, _compute_vertex_normals(cup, faced))
    away, height = np.linalg.norm(cup.vertices[:, :2], axis=1), cup.vertices[:, 2]
    floor = (np.abs(height - 0.004) < 1e-6) & (away < 0.0365)
    assert floor.sum() == 40
    assert (inside[floor] == INSIDE_M).all()
    assert (inside[(away > 0.0395) & (height < 0.099)] == 0.0).all()
