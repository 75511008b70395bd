"""What overhangs a narrow thing stands on it; that thing lies in nothing, and goes on up to it."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.objects import PerceivedObject, PerceivedObjects, Table
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.stages.perceive.depth_segmenter.containment import find_containers_by_outline
from tableverse_factory.stages.perceive.table import find_table
from tableverse_factory.stages.place.view.object_view import view_object
from tableverse_factory.stages.place.view.support_from_depth import find_supports
from tests.helpers.tabletop_views import Box, camera_above, look

TRAY_Z = 0.16
POST, TRAY = Box(0.0, 0.0, (0.06, 0.06, TRAY_Z)), Box(0.0, 0.0, (0.2, 0.2, 0.06), z=TRAY_Z)
BESIDE = Box(0.25, 0.1, (0.06, 0.06, 0.12))
TABLE = Table(np.zeros(2), np.ones(2), 0.0, (0, 0, 0), 0.0)


def photograph(things, pitch_deg, noise_m) -> PerceivedObjects:
    camera = camera_above(0.5, 0.75, pitch_deg)
    observation, truth = look(things, camera_to_table=camera, noise_m=noise_m)
    ids = np.where(truth > 1, truth - 1, 0).astype(np.int32)
    points = backproject(observation.depth, observation.camera)
    own = {k: (ids == k) & (observation.depth > 0) for k in range(1, len(things) + 1)}
    assert all(mask.sum() > 500 for mask in own.values())
    objects = tuple(
        PerceivedObject(f"obj_{k}", k, "thing", 1.0, points[m], observation.color[m]) for k, m in own.items()
    )
    return PerceivedObjects("view", observation, camera, TABLE, ids, objects, "view")


@pytest.mark.parametrize("noise_m", [0.0012, pytest.param(0.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("pitch_deg", [25.0, 35.0])
def test_a_tray_stands_on_the_post_that_it_hides_in_part(pitch_deg, noise_m):
    scene = photograph([POST, TRAY, BESIDE], pitch_deg, noise_m)
    view = find_table(scene.observation, np.random.default_rng(0))
    assert find_containers_by_outline(scene.instance_ids, view) == {}
    supports = find_supports(scene.objects, scene.camera_to_table)
    assert supports["obj_2"].carrier == "obj_1"
    assert supports["obj_2"].height == pytest.approx(TRAY_Z, abs=0.01)
    assert [supports[name].height for name in ("obj_1", "obj_3")] == [0.0, 0.0]
    assert supports["obj_1"].ceiling == supports["obj_2"].height
    assert [supports[name].ceiling for name in ("obj_2", "obj_3")] == [0.0, 0.0]


def view_post(scene):
    """The post as seen, and as it goes on up to what stands on it."""
    post = scene.objects[0]
    support = find_supports(scene.objects, scene.camera_to_table)[post.object_id]
    return view_object(scene, post, replace(support, ceiling=0.0)), view_object(scene, post, support)


@pytest.mark.parametrize("noise_m", [0.0012, pytest.param(0.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("pitch_deg", [25.0, 35.0])
def test_a_post_goes_on_up_to_the_tray_that_hides_its_top(pitch_deg, noise_m):
    seen, whole = view_post(photograph([POST, TRAY], pitch_deg, noise_m))
    assert np.quantile(seen.points[:, 2], 0.98) < TRAY_Z - 0.02
    added = whole.points[len(seen.points) :]
    assert np.array_equal(whole.points[: len(seen.points)], seen.points)
    assert added[:, 2].max() == pytest.approx(whole.support.ceiling, abs=0.0005)
    assert np.diff(np.sort(added[:, 2])).max() < 0.005
    assert np.abs(added[:, :2]).max() < 0.03 + 0.005
    assert len(whole.points) == len(whole.normals) == len(whole.colors)


@pytest.mark.parametrize("noise_m", [0.0, 0.0012])
def test_a_post_that_is_seen_whole_is_left_alone(noise_m):
    small = Box(0.0, 0.01, (0.03, 0.03, 0.05), z=TRAY_Z)
    seen, whole = view_post(photograph([POST, small], 35.0, noise_m))
    assert whole.support.ceiling == pytest.approx(TRAY_Z, abs=0.005)
    assert np.array_equal(whole.points, seen.points)
