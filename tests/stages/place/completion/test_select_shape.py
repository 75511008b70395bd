"""Selection among kinds of shape: no finished shape costs less than its draft said."""

import numpy as np
import pytest
import trimesh

from tableverse_factory.evaluation.bench.completion import render_noisy_view, stand_on_table
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.stages.place.completion.ray_misfit import sample_rays
from tableverse_factory.stages.place.completion.select_shape import KINDS, complete_by_carving
from tableverse_factory.stages.place.view.object_view import view_object
from tableverse_factory.stages.place.view.support_from_depth import find_supports

SHAPES = {
    "box": trimesh.creation.box((0.12, 0.07, 0.05)),
    "torus": trimesh.creation.torus(0.05, 0.02),
    "capsule": trimesh.creation.capsule(0.08, 0.025),
}
ONE_FOR_THE_FAST_RUN = [pytest.param(name, marks=[] if name == "box" else pytest.mark.slow) for name in SHAPES]


@pytest.mark.parametrize("name", ONE_FOR_THE_FAST_RUN)
def test_no_shape_costs_less_than_its_draft_and_the_cheapest_is_selected(name):
    scene = render_noisy_view([stand_on_table(from_trimesh(SHAPES[name]))], 0.7, 0.8, np.random.default_rng(3))
    support = find_supports(scene.objects, scene.camera_to_table)[scene.objects[0].object_id]
    view = view_object(scene, scene.objects[0], support)
    rays, costs = sample_rays(view), {}
    for kind in KINDS:
        if (draft := kind.make(view, rays)) is not None:
            costs[kind.method] = draft.finish()[2] + kind.freedom
            assert costs[kind.method] >= draft.least + kind.freedom
    assert len(costs) >= 4
    assert complete_by_carving(scene, view).method == min(costs, key=costs.__getitem__)
