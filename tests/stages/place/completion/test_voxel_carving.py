"""Carved surfaces: crumbs beside the solid go, and the solid stays as it is."""

import numpy as np

from tableverse_factory.geometry.mesh.voxel_solids import extract_surface, find_largest_part, make_grid, to_manifold
from tableverse_factory.stages.place.completion.voxel_carving import drop_crumbs


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
