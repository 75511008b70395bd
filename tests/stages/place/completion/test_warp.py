"""Thin walls follow the seen surface where it is not quite round; solids stay as they were fitted."""

import numpy as np
import pytest
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.evaluation.bench.completion import render_noisy_view, score_completion, stand_on_table
from tableverse_factory.geometry.math.transforms import translate_pose
from tableverse_factory.geometry.mesh.meshes import from_trimesh, place_mesh
from tableverse_factory.geometry.mesh.voxel_solids import to_manifold
from tableverse_factory.stages.place.completion.ray_misfit import sample_rays
from tableverse_factory.stages.place.completion.revolution import fit_revolution
from tableverse_factory.stages.place.completion.select_shape import complete_by_carving
from tableverse_factory.stages.place.completion.warp import warp_to_depth
from tableverse_factory.stages.place.view.object_view import ObjectView, view_object
from tableverse_factory.stages.place.view.support_from_depth import find_supports

THICKNESS_M = 0.0012


def make_bent_plate() -> TriangleMesh:
    """A plate of 24 cm whose rim rises and falls by a millimetre, twice around."""
    under = np.array([(0.0, 0.0), (0.03, 0.0), (0.07, 0.0), (0.085, 0.01), (0.12, 0.022)])
    outline = np.vstack([under, under[::-1] + np.array([0.0, THICKNESS_M])])
    vertices = trimesh.creation.revolve(outline, sections=96)
    x, y, z = vertices.vertices.T
    bent = np.stack([x, y, z + 0.001 * (x**2 - y**2) / 0.12**2], axis=1)
    return stand_on_table(from_trimesh(trimesh.Trimesh(bent, vertices.faces, process=False)))


def look(mesh: TriangleMesh, seed: int = 5) -> ObjectView:
    scene = render_noisy_view([mesh], 0.9, 0.8, np.random.default_rng(seed))
    support = find_supports(scene.objects, scene.camera_to_table)[scene.objects[0].object_id]
    return view_object(scene, scene.objects[0], support)


@pytest.mark.parametrize("seed", [5, 6])
def test_a_bent_plate_is_bent_and_stays_a_solid(seed):
    plate = make_bent_plate()
    view = look(plate, seed)
    fit = fit_revolution(view, sample_rays(view))
    assert fit is not None
    mesh, pose, _, _ = fit
    warped = warp_to_depth(mesh, pose, view)
    to_manifold(warped)
    before, after = (
        score_completion("plate", 0, "", plate, place_mesh(found, pose, 1.0)).iou for found in (mesh, warped)
    )
    assert after > before + 0.1
    assert after > 0.55


def test_what_was_not_seen_where_it_stands_stays_as_it_is():
    view = look(make_bent_plate())
    fit = fit_revolution(view, sample_rays(view))
    assert fit is not None
    away = translate_pose(fit[1], np.array([0.0, 0.0, 0.1]))
    assert warp_to_depth(fit[0], away, view) is fit[0]


def test_a_solid_stays_round():
    can = from_trimesh(trimesh.creation.cylinder(radius=0.034, height=0.1, sections=96))
    scene = render_noisy_view([stand_on_table(can)], 0.9, 0.6, np.random.default_rng(5))
    found = complete_by_carving(scene, look(stand_on_table(can)))
    assert found.method == "carved/revolution"
    away = np.linalg.norm(found.mesh.vertices[:, :2], axis=1)
    side = away[away > 0.03]
    # Forty corners of a ring, all at one distance to within its tapers and noise of the profile.
    heights = found.mesh.vertices[away > 0.03, 2]
    rings = [side[np.abs(heights - z) < 1e-6] for z in np.unique(heights.round(6))]
    assert max(float(np.ptp(ring)) for ring in rings) < 1e-5


@pytest.mark.parametrize(("wall", "floor"), [(0.002, 0.004), (0.002, 0.012), (0.004, 0.012)])
@pytest.mark.parametrize("elevation", [0.7, 1.1])
def test_a_cup_stands_on_the_table(wall, floor, elevation):
    outline = [(0, 0), (0.04, 0), (0.04, 0.07), (0.04 - wall, 0.07), (0.04 - wall, floor), (0, floor)]
    scene = render_noisy_view(
        [from_trimesh(trimesh.creation.revolve(np.array(outline), sections=64))],
        0.7,
        elevation,
        np.random.default_rng(3),
    )
    support = find_supports(scene.objects, scene.camera_to_table)[scene.objects[0].object_id]
    found = complete_by_carving(scene, view_object(scene, scene.objects[0], support))
    assert found.pose is not None
    lowest = place_mesh(found.mesh, found.pose, 1.0).vertices[:, 2].min()
    assert support.height - 1e-6 < lowest < support.height + 0.001
