"""Carved surfaces: crumbs beside the solid go, floors are closed, and the solid and its holes stay as they are."""

import numpy as np
import pytest
import trimesh
from manifold3d import CrossSection

from tableverse_factory.evaluation.bench.completion import render_noisy_view, stand_on_table
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.mesh.voxel_solids import extract_surface, find_largest_part, make_grid, to_manifold
from tableverse_factory.stages.place.completion.inflation import inflate
from tableverse_factory.stages.place.completion.voxel_carving import carve_columns, drop_crumbs
from tableverse_factory.stages.place.view.object_view import ObjectView, view_object
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


def look(mesh: trimesh.Trimesh, elevation: float) -> ObjectView:
    scene = render_noisy_view([stand_on_table(from_trimesh(mesh))], 0.7, elevation, np.random.default_rng(3))
    supports = find_supports(scene.objects, scene.camera_to_table)
    return view_object(scene, scene.objects[0], supports[scene.objects[0].object_id])


@pytest.mark.parametrize("carve", [carve_columns, inflate])
def test_a_floor_that_was_seen_no_higher_than_the_table_has_no_hole(carve):
    profile = [[0.0, 0.0], [0.03, 0.0], [0.06, 0.04], [0.056, 0.04], [0.028, 0.0004], [0.0, 0.0004]]
    carved = carve(look(trimesh.creation.revolve(profile), 0.9))
    at_floor = to_manifold(carved.simplify()).slice(0.001 - carved.pose.position[2])
    true_floor = CrossSection.circle(0.024, 64).translate(-carved.pose.position[:2])
    assert (at_floor ^ true_floor).area() > 0.98 * true_floor.area()


@pytest.mark.parametrize("carve", [carve_columns, inflate])
def test_a_hole_that_shows_the_table_stays_open(carve):
    ring = trimesh.creation.annulus(0.006, 0.025, 0.01)
    carved = carve(look(ring, 1.3))
    assert to_manifold(carved.simplify()).genus() == 1
