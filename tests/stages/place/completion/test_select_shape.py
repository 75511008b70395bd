"""Selection among kinds of shape: the cheapest wins, and each solid gets its kind."""

from functools import partial

import numpy as np
import pytest
import trimesh

from tableverse_factory.evaluation.bench.completion import render_noisy_view, score_completion, stand_on_table
from tableverse_factory.evaluation.bench.solids import make_solids
from tableverse_factory.geometry.mesh.meshes import from_trimesh, place_mesh
from tableverse_factory.geometry.mesh.voxel_solids import to_manifold
from tableverse_factory.stages.place.completion.ray_misfit import sample_rays
from tableverse_factory.stages.place.completion.select_shape import (
    KINDS,
    PLAIN_KINDS,
    SOLID_KINDS,
    complete_by_carving,
    try_kinds,
)
from tableverse_factory.stages.place.view.object_view import view_object
from tableverse_factory.stages.place.view.support_from_depth import find_supports

SHAPES = {
    "box": trimesh.creation.box((0.12, 0.07, 0.05)),
    "torus": trimesh.creation.torus(0.05, 0.02),
    "capsule": trimesh.creation.capsule(0.08, 0.025),
}
SOLIDS = {name: stand_on_table(mesh) for name, mesh in make_solids()}
SLOW = partial(pytest.param, marks=pytest.mark.slow)  # one of each is in the fast run


def see(mesh, error_m=0.0, seed=3, elevation=0.8):
    """See a mesh with a sensor: the scene and the view of its object."""
    scene = render_noisy_view([mesh], 0.7, elevation, np.random.default_rng(seed), error_m=error_m)
    support = find_supports(scene.objects, scene.camera_to_table)[scene.objects[0].object_id]
    return scene, view_object(scene, scene.objects[0], support)


@pytest.mark.parametrize("name", ["box", SLOW("torus"), SLOW("capsule")])
def test_no_shape_costs_less_than_its_draft_and_the_cheapest_is_selected(name):
    scene, view = see(stand_on_table(from_trimesh(SHAPES[name])))
    rays, costs = sample_rays(view), {}
    for kind in KINDS:
        if (draft := kind.make(view, rays)) is not None:
            costs[kind.method] = draft.finish()[2] + kind.freedom
            assert costs[kind.method] >= draft.least + kind.freedom
    assert len(costs) >= 4
    assert complete_by_carving(scene, view).method == min(costs, key=costs.__getitem__)


@pytest.mark.parametrize("name", [name if name == "meat tin" else SLOW(name) for name in SOLIDS])
def test_no_best_shape_is_lost_by_what_drafts_expect(name):
    """All radii and rounded edges are fitted only where a shape may win by the gain expected of them."""
    _, view = see(SOLIDS[name], error_m=0.004)
    rays = sample_rays(view, estimated=True)
    for kinds in (PLAIN_KINDS, SOLID_KINDS):
        drafts = [(kind, draft) for kind in kinds if (draft := kind.make(view, rays)) is not None]
        assert len(drafts) >= 2
        cost, method = min((draft.finish()[2] + kind.freedom, kind.method) for kind, draft in drafts)
        best = try_kinds(kinds, view, rays, 0.0).best
        assert best is not None
        assert best[:2] == (pytest.approx(cost), method)


@pytest.mark.parametrize(
    ("name", "error_m"), [("meat tin", 0.006), SLOW("meat tin", 0.0), ("carton", 0.003), SLOW("carton", 0.0)]
)
def test_a_tin_has_round_edges_and_a_carton_sharp_ones(name, error_m):
    scene, view = see(SOLIDS[name], error_m)
    found = complete_by_carving(scene, view)
    assert found.method == "carved/box"
    share = to_manifold(found.mesh).volume() / np.ptp(found.mesh.vertices, axis=0).prod()
    assert share < 0.97 if name == "meat tin" else share > 0.999
    iou = score_completion(name, 0, found.method, SOLIDS[name], place_mesh(found.mesh, found.pose)).iou
    assert iou > (0.85 if error_m else 0.93)


@pytest.mark.parametrize("name", ["can", SLOW("round tin")])
def test_what_is_round_is_no_box(name):
    _, view = see(SOLIDS[name], error_m=0.004)
    best = try_kinds(SOLID_KINDS, view, sample_rays(view, estimated=True), 0.0).best
    assert best is not None
    assert best[1] == "carved/turned"


@pytest.mark.parametrize(("name", "elevation"), [("bowl", 1.05), SLOW("plate", 0.8)])
def test_a_wall_whose_outside_is_hidden_is_as_thick_as_its_rim(name, elevation):
    scene, view = see(SOLIDS[name], elevation=elevation)
    found = complete_by_carving(scene, view)
    assert found.method == "carved/revolution"
    assert score_completion(name, 0, found.method, SOLIDS[name], place_mesh(found.mesh, found.pose)).iou > 0.65
