"""Filters of regions: noise of a sensor raises scraps of a far table, and nothing that a net sees."""

import numpy as np
import pytest

from schemas.outcome import Dropped
from tableverse_factory.stages.perceive.base.object_filter import keep_objects
from tableverse_factory.stages.perceive.table import find_table
from tests.helpers.tabletop_views import Box, camera_above, look


@pytest.mark.parametrize(("height", "by_depth", "kept"), [(0.6, True, 1), (1.6, True, 0), (1.6, False, 1)])
def test_a_small_thing_far_away_is_an_object_unless_noise_may_have_raised_it(height, by_depth, kept):
    seen, ids = look([Box(0.0, 0.0, (0.04, 0.04, 0.04))], camera_above(height, height / 0.84))
    view = find_table(seen, np.random.default_rng(0))
    assert not isinstance(view, Dropped), view
    regions = np.where(ids == 2, 1, 0).astype(np.int32)
    assert keep_objects(regions, view, by_depth=by_depth).max() == kept
