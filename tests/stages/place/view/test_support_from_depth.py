"""What overhangs a narrow thing stands on it; that thing lies in nothing."""

import numpy as np
import pytest

from schemas.objects import PerceivedObject
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.stages.perceive.depth_segmenter.containment import find_containers_by_outline
from tableverse_factory.stages.perceive.table import find_table
from tableverse_factory.stages.place.view.support_from_depth import find_supports
from tests.helpers.tabletop_views import Box, camera_above, look

TRAY_Z = 0.16
POST, TRAY = Box(0.0, 0.0, (0.06, 0.06, TRAY_Z)), Box(0.0, 0.0, (0.2, 0.2, 0.06), z=TRAY_Z)
BESIDE = Box(0.25, 0.1, (0.06, 0.06, 0.12))


@pytest.mark.parametrize("noise_m", [0.0, 0.0012])
@pytest.mark.parametrize("pitch_deg", [25.0, 35.0])
def test_a_tray_stands_on_the_post_that_it_hides_in_part(pitch_deg, noise_m):
    camera = camera_above(0.5, 0.75, pitch_deg)
    observation, truth = look([POST, TRAY, BESIDE], camera_to_table=camera, noise_m=noise_m)
    ids = np.where(truth > 1, truth - 1, 0).astype(np.int32)
    assert [int((ids == k).sum()) > 500 for k in (1, 2, 3)] == [True] * 3
    assert find_containers_by_outline(ids, find_table(observation, np.random.default_rng(0))) == {}
    points = backproject(observation.depth, observation.camera)
    own = {k: (ids == k) & (observation.depth > 0) for k in (1, 2, 3)}
    objects = [PerceivedObject(f"obj_{k}", k, "thing", 1.0, points[own[k]], observation.color[own[k]]) for k in own]
    supports = find_supports(objects, camera)
    assert supports["obj_2"].carrier == "obj_1"
    assert supports["obj_2"].height == pytest.approx(TRAY_Z, abs=0.01)
    assert [supports[name].height for name in ("obj_1", "obj_3")] == [0.0, 0.0]
