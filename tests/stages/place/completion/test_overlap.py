"""Overlaps of hidden parts are removed, and nothing that the picture shows."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.evaluation.bench.completion import render_noisy_view
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.mesh.voxel_solids import to_manifold
from tableverse_factory.stages.place.completion.overlap import FREE, find_upright_plane, remove_overlaps
from tableverse_factory.stages.place.completion.ray_misfit import compute_mesh_misfit, sample_rays
from tableverse_factory.stages.place.interfaces import Completion
from tableverse_factory.stages.place.view.object_view import view_object
from tableverse_factory.stages.place.view.support_from_depth import find_supports

AT = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


def make_block(low: tuple[float, float, float], high: tuple[float, float, float]) -> TriangleMesh:
    return from_trimesh(trimesh.creation.box(bounds=(low, high)))


NEAR, FAR = make_block((-0.03, -0.06, 0.0), (0.03, 0.0, 0.09)), make_block((-0.04, 0.02, 0.0), (0.04, 0.08, 0.06))
TOO_DEEP = make_block((-0.03, -0.06, 0.0), (0.03, 0.05, 0.09))  # its front is that of NEAR, its back reaches into FAR


@pytest.fixture(scope="module")
def seen():
    scene = render_noisy_view([NEAR, FAR], -np.pi / 2, 0.35, np.random.default_rng(1))
    supports = find_supports(scene.objects, scene.camera_to_table)
    return scene, [view_object(scene, item, supports[item.object_id]) for item in scene.objects]


def measure_overlap(one: Completion, other: Completion) -> float:
    return (to_manifold(one.mesh) ^ to_manifold(other.mesh)).volume()


@pytest.mark.parametrize("method", FREE)
def test_a_hidden_back_gives_way_to_what_stands_behind(seen, method):
    scene, views = seen
    deep, box = Completion(TOO_DEEP, AT, method), Completion(FAR, AT, "carved/box")
    assert measure_overlap(deep, box) > 5e-5
    cut, same = remove_overlaps(scene, views, [deep, box])
    assert same is box
    assert cut.method == method
    assert measure_overlap(cut, same) < 1e-9
    rays = sample_rays(views[0])
    assert compute_mesh_misfit(rays, cut.mesh, AT) <= compute_mesh_misfit(rays, TOO_DEEP, AT) + 2e-4


def test_boxes_keep_their_shape_and_what_is_seen_stays(seen):
    scene, views = seen
    boxes = [Completion(mesh, AT, "carved/box") for mesh in (TOO_DEEP, FAR)]
    assert all(found is given for found, given in zip(remove_overlaps(scene, views, boxes), boxes, strict=True))
    swallowing = Completion(make_block((-0.05, -0.06, 0.0), (0.05, 0.09, 0.09)), AT, "carved/box")
    inner = Completion(FAR, AT, "carved/inflation")
    left = remove_overlaps(scene, views, [swallowing, inner])[1]
    rays = sample_rays(views[1])
    assert compute_mesh_misfit(rays, left.mesh, AT) <= compute_mesh_misfit(rays, FAR, AT) + 2e-4
    assert to_manifold(left.mesh).volume() >= 0.4 * to_manifold(FAR).volume()


def test_what_stands_on_another_or_in_it_stays(seen):
    scene, views = seen
    pair = [Completion(TOO_DEEP, AT, "carved/inflation"), Completion(FAR, AT, "carved/box")]
    near, far = scene.objects
    on_top = [replace(views[0], support=replace(views[0].support, carrier=far.object_id)), views[1]]
    assert remove_overlaps(scene, on_top, pair)[0] is pair[0]
    inside = replace(scene, objects=(replace(near, contained_in=far.object_id), far))
    assert remove_overlaps(inside, views, pair)[0] is pair[0]


def test_the_plane_parts_clouds_and_forgives_a_few_strays():
    rng = np.random.default_rng(0)
    one, other = rng.normal((0.1, 0.02, 0.0), 0.01, (300, 3)), rng.normal((-0.1, 0.0, 0.0), 0.01, (200, 3))
    normal, offset = find_upright_plane(one, other)
    assert normal[2] == 0.0
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    assert (one @ normal > offset).all()
    assert (other @ normal < offset).all()
    strayed = np.concatenate([one, [[-0.12, 0.0, 0.0]]])
    normal, offset = find_upright_plane(strayed, other)
    assert (strayed @ normal > offset).sum() >= 300
    assert find_upright_plane(one[:, :] * [1, 1, 0], other) is None
