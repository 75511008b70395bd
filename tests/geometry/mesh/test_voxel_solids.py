import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.planes import fit_min_rectangle
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume
from tableverse_factory.geometry.mesh.meshes import to_trimesh
from tableverse_factory.geometry.mesh.voxel_solids import (
    extract_surface,
    from_manifold,
    make_grid,
    simplify_solid,
    to_manifold,
)


def ball_field(radius: float, cell: float, center: np.ndarray):
    grid = make_grid(np.full(3, -radius - cell), np.full(3, radius + cell), cell)
    return (radius - np.linalg.norm(grid.points() - center, axis=1)).reshape(grid.shape), grid


@settings(max_examples=5, deadline=None)
@given(st.floats(0.02, 0.1), st.tuples(*[st.floats(-0.4, 0.4)] * 3))
def test_the_surface_of_a_ball_is_closed_faces_outward_and_has_its_volume(radius, offset) -> None:
    cell = radius / 10
    field, grid = ball_field(radius, cell, np.array(offset) * cell)
    mesh = extract_surface(field, grid)
    assert to_trimesh(mesh).is_watertight
    assert compute_signed_volume(mesh) == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.02)
    small = from_manifold(simplify_solid(to_manifold(mesh), 1000, 0.01 * cell))
    assert len(small.faces) <= 1000
    assert to_trimesh(small).is_watertight
    assert compute_signed_volume(small) == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.04)


def test_a_solid_that_reaches_the_edge_of_its_grid_is_closed_there() -> None:
    grid = make_grid(np.zeros(3), np.full(3, 0.1), 0.01)
    mesh = extract_surface(np.ones(grid.shape), grid)
    assert to_trimesh(mesh).is_watertight
    assert compute_signed_volume(mesh) > 0.001


def test_a_field_that_is_nowhere_positive_is_no_solid() -> None:
    grid = make_grid(np.zeros(3), np.full(3, 0.1), 0.01)
    with pytest.raises(GeometryError, match="nowhere"):
        extract_surface(-np.ones(grid.shape), grid)


points = st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=3, max_size=40)


@settings(max_examples=60, deadline=None)
@given(points, st.floats(-3.0, 3.0))
def test_the_smallest_rectangle_holds_all_points_and_turns_with_them(pairs, angle) -> None:
    cloud = np.array(pairs)
    spread = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-3:
        return
    rectangle = fit_min_rectangle(cloud)
    assert max(rectangle.distance(point) for point in cloud) < 1e-9
    c, s = np.cos(angle), np.sin(angle)
    turned = fit_min_rectangle(cloud @ np.array([[c, s], [-s, c]]))
    assert np.prod(turned.half_size) == pytest.approx(np.prod(rectangle.half_size), rel=1e-6)
    assert np.prod(rectangle.half_size) <= np.prod(np.ptp(cloud, axis=0)) / 4 + 1e-12


def test_points_on_a_line_have_no_rectangle() -> None:
    with pytest.raises(GeometryError, match="no area"):
        fit_min_rectangle(np.column_stack([np.arange(5.0), np.arange(5.0)]))
