"""Carved surfaces: crumbs beside the solid go, and the solid stays as it is."""

import numpy as np
import pytest
import trimesh

from tableverse_factory.evaluation.bench.completion import render_noisy_view
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.mesh.voxel_solids import extract_surface, find_largest_part, make_grid, to_manifold
from tableverse_factory.stages.place.completion.underside import Footprint
from tableverse_factory.stages.place.completion.voxel_carving import (
    MAX_CELLS,
    build_flat_grid,
    compute_column_field,
    drop_crumbs,
)
from tableverse_factory.stages.place.view.object_view import view_object
from tableverse_factory.stages.place.view.support_from_depth import find_supports


def test_without_its_crumbs_a_solid_keeps_its_surface():
    grid = make_grid(np.full(3, -1.0), np.full(3, 1.0), 0.05)
    points = grid.points()
    ball = 0.5 - np.linalg.norm(points, axis=1)
    crumbs = [0.08 - np.linalg.norm(points - center, axis=1) for center in ([0.7, 0.0, 0.0], [0.0, -0.7, 0.1])]
    field = np.maximum.reduce([ball, *crumbs]).reshape(grid.shape)
    whole = to_manifold(extract_surface(field, grid))
    assert len(whole.decompose()) == 3
    clean = to_manifold(extract_surface(drop_crumbs(field), grid))
    assert len(clean.decompose()) == 1
    assert np.isclose(clean.volume(), find_largest_part(whole).volume(), rtol=1e-12)
    assert clean.num_tri() == find_largest_part(whole).num_tri()


def test_two_large_parts_both_stay():
    grid = make_grid(np.full(3, -1.0), np.full(3, 1.0), 0.05)
    points = grid.points()
    field = np.maximum(*(0.3 - np.linalg.norm(points - [x, 0.0, 0.0], axis=1) for x in (-0.5, 0.5))).reshape(grid.shape)
    assert (drop_crumbs(field) == field).all()


def test_columns_in_one_line_have_nothing_to_bridge():
    """As of a pen that a cup hides in the middle."""
    closed = np.zeros((9, 40), dtype=bool)
    closed[4, 2:15] = closed[4, 25:38] = True
    top = np.full(closed.shape, 0.01)
    footprint = Footprint(0.0015, closed, top, top, np.zeros(closed.shape), np.array([0.6, 0.0, 0.8]))
    z = np.linspace(0.0, 0.012, 9)
    free = np.ones((*closed.shape, len(z)))
    field = compute_column_field(footprint, 0.0, z, free, bridged=True)
    assert ((field > 0.0).any(axis=2) == closed).all()


@pytest.mark.parametrize(
    "size", [(0.3, 0.3, 0.2), (3.0, 3.0, 1.5), (3.0, 0.1, 0.02), (10.0, 10.0, 0.02), (8.0, 6.0, 0.003)]
)
def test_a_grid_has_a_bounded_number_of_cells_however_large_the_thing(size):
    scene = render_noisy_view([from_trimesh(trimesh.creation.box((0.1, 0.1, 0.1)))], 0.7, 0.8, np.random.default_rng(3))
    support = find_supports(scene.objects, scene.camera_to_table)[scene.objects[0].object_id]
    view = view_object(scene, scene.objects[0], support)
    grid, _ = build_flat_grid(view, np.array(size) / 2)
    assert np.prod(grid.shape) <= MAX_CELLS
