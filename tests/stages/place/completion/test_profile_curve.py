"""Cups and bowls: a wall is as thick as it is, its floor as high as it was seen."""

import numpy as np
import pytest
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.evaluation.bench.completion import contains_points, render_noisy_view
from tableverse_factory.geometry.mesh.meshes import from_trimesh, place_mesh
from tableverse_factory.geometry.mesh.voxel_solids import to_manifold
from tableverse_factory.stages.place.completion.ray_misfit import sample_rays
from tableverse_factory.stages.place.completion.revolution import fit_revolution
from tableverse_factory.stages.place.view.object_view import view_object
from tableverse_factory.stages.place.view.support_from_depth import find_supports

RADIUS_M, HEIGHT_M = 0.04, 0.07
STEP_M = 1e-4


def cup(wall: float, floor: float) -> TriangleMesh:
    inner = RADIUS_M - wall
    outline = [(0, 0), (RADIUS_M, 0), (RADIUS_M, HEIGHT_M), (inner, HEIGHT_M), (inner, floor), (0, floor)]
    return from_trimesh(trimesh.creation.revolve(np.array(outline), sections=64))


def complete(mesh: TriangleMesh, elevation: float) -> TriangleMesh:
    scene = render_noisy_view([mesh], 0.7, elevation, np.random.default_rng(3))
    view = view_object(
        scene, scene.objects[0], find_supports(scene.objects, scene.camera_to_table)[scene.objects[0].object_id]
    )
    fit = fit_revolution(view, sample_rays(view))
    assert fit is not None
    assert fit[3]
    return place_mesh(fit[0], fit[1])


def measure_solid(mesh: TriangleMesh, start: np.ndarray, along: np.ndarray, length: float) -> float:
    steps = np.arange(0.0, length, STEP_M)
    return STEP_M * float(contains_points(mesh, start + steps[:, None] * along).sum())


@pytest.mark.parametrize("wall", [0.002, 0.004, 0.006])
def test_a_wall_seen_from_both_sides_is_as_thick_as_it_is(wall):
    whole = complete(cup(wall, 0.006), elevation=0.7)
    directions = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.arange(0.0, 2 * np.pi, 0.5)]
    middle = np.array([0.0, 0.0, 0.6 * HEIGHT_M])
    found = np.mean([measure_solid(whole, middle, direction, 2 * RADIUS_M) for direction in directions])
    assert abs(found - wall) < 0.0007


@pytest.mark.parametrize("floor", [0.004, 0.012])
def test_a_floor_seen_is_as_high_as_it_is(floor):
    whole = complete(cup(0.004, floor), elevation=1.1)
    z = np.arange(0.0, HEIGHT_M, STEP_M)
    for x in (-0.015, 0.0, 0.015):
        solid = contains_points(whole, np.stack([np.full(len(z), x), np.zeros(len(z)), z], axis=1))
        assert abs(z[solid][-1] - floor) < 0.001


def test_what_rests_on_its_sheet_is_no_thicker_than_its_inside_is_high():
    thickness = 0.0012
    under = np.array([(0.0, 0.0), (0.07, 0.0), (0.085, 0.01), (0.12, 0.022)])
    outline = np.vstack([under, under[::-1] + np.array([0.0, thickness])])
    plate = complete(from_trimesh(trimesh.creation.revolve(outline, sections=96)), elevation=0.9)
    for radius in (0.02, 0.05, 0.1):
        starts = [np.array([radius * np.cos(a), radius * np.sin(a), -0.001]) for a in np.arange(0.0, 2 * np.pi, 0.5)]
        found = np.mean([measure_solid(plate, start, np.array([0.0, 0.0, 1.0]), 0.05) for start in starts])
        assert abs(found - thickness) < 0.0005, radius


@pytest.mark.parametrize("foot", [0.0, 0.006])
def test_a_plate_whose_sheet_rests_has_no_foot_and_a_raised_one_has(foot):
    """A sheet of 2 mm that rises from the middle, alone or on a disc."""
    under = np.array([(0.0, 0.0), (0.03, 0.0), (0.03, foot), (0.06, foot + 0.012), (0.1, foot + 0.03)])
    over = np.array([(0.1, foot + 0.032), (0.06, foot + 0.014), (0.03, foot + 0.002), (0.0, foot + 0.002)])
    plate = complete(from_trimesh(trimesh.creation.revolve(np.vstack([under, over]), sections=96)), elevation=0.9)
    assert plate.vertices[:, 2].min() < 0.001
    starts = [np.array([0.045 * np.cos(a), 0.045 * np.sin(a), -0.001]) for a in np.arange(0.0, 2 * np.pi, 0.5)]
    assert np.mean([measure_solid(plate, start, np.array([0.0, 0.0, 1.0]), 0.003 + foot) for start in starts]) < 0.0005


def test_under_the_domed_floor_of_a_plate_that_rests_on_its_rim_nothing_is_filled():
    under = np.array([(0.0, 0.0025), (0.03, 0.0015), (0.06, 0.0), (0.1, 0.02)])
    plate = complete(
        from_trimesh(trimesh.creation.revolve(np.vstack([under, under[::-1] + np.array([0.0, 0.0015])]), sections=96)),
        elevation=0.9,
    )
    starts = [np.array([0.008 * np.cos(a), 0.008 * np.sin(a), -0.001]) for a in np.arange(0.0, 2 * np.pi, 0.5)]
    assert np.mean([measure_solid(plate, start, np.array([0.0, 0.0, 1.0]), 0.0025) for start in starts]) < 0.0007


@pytest.mark.parametrize("elevation", [0.44, 0.61, 0.87])
def test_a_thin_plate_with_a_raised_middle_has_one_thickness_from_low_and_high(elevation):
    """The noise of the floor looks like an outside at the height of the ring on which the plate rests."""
    thickness = 0.0012
    under = np.array([(0.0, 0.0024), (0.05, 0.0016), (0.078, 0.0), (0.09, 0.01), (0.128, 0.022)])
    outline = np.vstack([under, under[::-1] + np.array([0.0, thickness])])
    plate = complete(from_trimesh(trimesh.creation.revolve(outline, sections=96)), elevation)
    for radius in (0.02, 0.05, 0.1):
        starts = [np.array([radius * np.cos(a), radius * np.sin(a), -0.001]) for a in np.arange(0.0, 2 * np.pi, 0.5)]
        found = np.mean([measure_solid(plate, start, np.array([0.0, 0.0, 1.0]), 0.05) for start in starts])
        assert abs(found - thickness) < 0.0006, radius


@pytest.mark.parametrize("elevation", [0.44, 0.61, 0.87])
def test_a_foot_is_as_wide_as_the_outside_seen_below_the_floor(elevation):
    outline = np.array([(0, 0), (0.035, 0), (0.045, 0.06), (0.039, 0.06), (0.022, 0.012), (0, 0.012)])
    whole = complete(from_trimesh(trimesh.creation.revolve(outline, sections=96)), elevation)
    low = whole.vertices[whole.vertices[:, 2] < whole.vertices[:, 2].min() + 0.001]
    assert abs(np.linalg.norm(low[:, :2], axis=1).max() - 0.035) < 0.0025


@pytest.mark.parametrize("elevation", [0.61, 0.87])
def test_under_the_rolled_rim_of_a_plate_nothing_is_filled(elevation):
    thickness = 0.0012
    under = np.array([(0, 0), (0.07, 0), (0.085, 0.01), (0.12, 0.0225), (0.1255, 0.0222), (0.1275, 0.0195)])
    outline = np.vstack([under, under[::-1] + np.array([0.0, thickness])])
    plate = complete(from_trimesh(trimesh.creation.revolve(outline, sections=96)), elevation)
    for radius in (0.116, 0.122):
        starts = [np.array([radius * np.cos(a), radius * np.sin(a), 0.0]) for a in np.arange(0.0, 2 * np.pi, 0.5)]
        found = np.mean([measure_solid(plate, start, np.array([0.0, 0.0, 1.0]), 0.04) for start in starts])
        assert abs(found - thickness) < 0.0006, radius


@pytest.mark.parametrize("elevation", [0.61, 0.87])
def test_a_plate_that_rests_on_two_points_is_no_thicker_than_its_lowest(elevation):
    thickness = 0.0012
    under = np.array([(0.0, 0.0), (0.07, 0.0), (0.085, 0.01), (0.12, 0.022)])
    outline = np.vstack([under, under[::-1] + np.array([0.0, thickness])])
    round_plate = trimesh.creation.revolve(outline, sections=96)
    x, y, z = round_plate.vertices.T
    bent = z + 0.2 * (x**2 - y**2)
    bent -= bent.min()
    plate = complete(
        from_trimesh(trimesh.Trimesh(np.stack([x, y, bent], axis=1), round_plate.faces, process=False)), elevation
    )
    starts = [np.array([0.05 * np.cos(a), 0.05 * np.sin(a), -0.005]) for a in np.arange(0.0, 2 * np.pi, 0.5)]
    found = np.mean([measure_solid(plate, start, np.array([0.0, 0.0, 1.0]), 0.05) for start in starts])
    assert abs(found - thickness) < 0.0005


@pytest.mark.parametrize("elevation", [0.5, 0.8])
def test_a_lip_thicker_than_the_wall_is_solid(elevation):
    outline = np.array([(0, 0), (0.05, 0), (0.06, 0.05), (0.071, 0.05), (0.071, 0.062), (0.057, 0.062), (0.047, 0.004)])
    bowl = complete(from_trimesh(trimesh.creation.revolve(np.vstack([outline, (0, 0.004)]), sections=96)), elevation)
    assert len(to_manifold(bowl).decompose()) == 1


def test_what_lies_in_a_bowl_does_not_thin_its_wall():
    wall = 0.005
    outline = np.array([(0, 0), (0.05, 0), (0.08, 0.05), (0.08 - wall, 0.05), (0.05 - wall, wall), (0, wall)])
    bowl = trimesh.creation.revolve(outline, sections=96)
    lump = trimesh.creation.icosphere(radius=0.015)
    lump.apply_translation([0.02, 0.012, wall + 0.012])
    whole = complete(from_trimesh(trimesh.util.concatenate([bowl, lump])), elevation=0.9)
    directions = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.arange(0.0, 2 * np.pi, 0.5)]
    found = np.mean([measure_solid(whole, np.array([0.0, 0.0, 0.04]), along, 0.1) for along in directions])
    assert abs(found - wall) < 0.001


def test_a_lying_can_whose_middle_is_hidden_is_no_wider_there():
    can = trimesh.creation.cylinder(0.037, 0.23, sections=64)
    can.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1.0, 0.0, 0.0]))
    can.apply_translation([0.0, 0.0, 0.037])
    post = trimesh.creation.box((0.05, 0.06, 0.15))
    post.apply_translation([0.09, 0.0, 0.075])
    scene = render_noisy_view([from_trimesh(can), from_trimesh(post)], 0.0, 0.6, np.random.default_rng(3))
    view = view_object(
        scene, scene.objects[0], find_supports(scene.objects, scene.camera_to_table)[scene.objects[0].object_id]
    )
    assert not (np.abs(view.points[:, 1]) < 0.02).any(), "the middle is seen"
    fit = fit_revolution(view, sample_rays(view))
    assert fit is not None
    found = place_mesh(fit[0], fit[1]).vertices
    middle = found[np.abs(found[:, 1]) < 0.05]
    assert np.ptp(middle[:, 2]) == pytest.approx(0.074, abs=0.003)
    assert np.ptp(found[:, 1]) == pytest.approx(0.23, abs=0.006)
