"""Filters of regions: noise raises scraps of a far table, and what stands on the floor stands on no table."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from schemas.outcome import Dropped
from tableverse_factory.stages.perceive.base.object_filter import drop_unseen_regions, keep_objects
from tableverse_factory.stages.perceive.table import find_table
from tests.helpers.tabletop_views import Box, camera_above, look


@pytest.mark.parametrize(("height", "by_depth", "kept"), [(0.6, True, 1), (1.6, True, 0), (1.6, False, 1)])
def test_a_small_thing_far_away_is_an_object_unless_noise_may_have_raised_it(height, by_depth, kept):
    seen, ids = look([Box(0.0, 0.0, (0.04, 0.04, 0.04))], camera_above(height, height / 0.84))
    view = find_table(seen, np.random.default_rng(0))
    assert not isinstance(view, Dropped), view
    regions = np.where(ids == 2, 1, 0).astype(np.int32)
    assert keep_objects(regions, view, by_depth=by_depth).max() == kept


@pytest.mark.parametrize(("bend", "beyond"), [(0.0, 0), (0.02, 0), (0.2, 1)])
def test_what_stands_on_the_floor_is_no_object_of_the_table(bend, beyond):
    """Unless a model's depth is so bent that it may stand on the table."""
    seen, ids = look(
        [Box(0.0, -0.1, (0.1, 0.1, 0.1))], camera_above(0.8, 0.9, 40.0), table_half=(0.35, 0.3), floor_z=-0.3
    )
    view = find_table(seen, np.random.default_rng(0))
    assert not isinstance(view, Dropped), view
    floor = np.zeros(ids.shape, np.int32)
    below = view.valid & (view.heights < -0.2) & (ids == 0)
    rows, columns = np.nonzero(below)
    near = np.abs(columns - np.median(columns)) < 60
    floor[rows[near], columns[near]] = 1
    assert (floor == 1).sum() > 500
    view = replace(view, observation=replace(view.observation, bend=bend))
    assert keep_objects(np.where(ids == 2, 2, floor), view, by_depth=False).max() == 1 + beyond


CLOTH, WHITE, BLACK, RED = (150, 150, 150), (255, 255, 255), (20, 20, 20), (190, 40, 45)


@pytest.mark.parametrize(
    ("tint", "cloth", "margin", "kept"),
    [
        pytest.param(CLOTH, CLOTH, 0, 0, id="depth alone"),
        pytest.param(BLACK, CLOTH, 0, 1, id="black"),
        pytest.param(BLACK, CLOTH, 4, 1, id="black, in a mask that is too wide"),
        pytest.param((168, 168, 168), CLOTH, 0, 1, id="a little lighter"),
        pytest.param(WHITE, WHITE, 0, 1, id="white on white, where the picture tells nothing"),
    ],
)
def test_a_small_region_that_the_picture_does_not_show_is_no_object(tint, cloth, margin, kept):
    seen, ids = look([Box(0.0, 0.0, (0.03, 0.03, 0.03))], camera_above(0.6, 0.7))
    mask = ids == 2
    color = np.full(seen.color.shape, cloth, np.uint8)
    color[mask] = tint
    view = find_table(replace(seen, color=color), np.random.default_rng(0))
    assert not isinstance(view, Dropped), view
    region = ndimage.binary_dilation(mask, iterations=margin) if margin else mask
    assert drop_unseen_regions(region.astype(np.int32), view).max() == kept


def test_a_cap_in_the_colour_of_what_lies_behind_is_seen_by_its_edge_to_what_it_closes():
    seen, ids = look([Box(0.0, 0.0, (0.03, 0.03, 0.03))], camera_above(0.6, 0.7))
    rows, _ = np.nonzero(ids == 2)
    cap = (ids == 2) & (np.arange(ids.shape[0])[:, None] < np.median(rows))
    color = np.full(seen.color.shape, CLOTH, np.uint8)
    color[(ids == 2) & ~cap] = RED
    view = find_table(replace(seen, color=color), np.random.default_rng(0))
    assert not isinstance(view, Dropped), view
    regions = np.where(cap, 1, np.where(ids == 2, 2, 0)).astype(np.int32)
    assert drop_unseen_regions(regions, view).max() == 2


def test_a_large_region_is_kept_whatever_the_picture_shows():
    seen, ids = look([Box(0.0, 0.0, (0.12, 0.12, 0.05))], camera_above(0.6, 0.7))
    view = find_table(replace(seen, color=np.full(seen.color.shape, CLOTH, np.uint8)), np.random.default_rng(0))
    assert not isinstance(view, Dropped), view
    assert drop_unseen_regions((ids == 2).astype(np.int32), view).max() == 1


def test_a_tall_thing_whose_foot_a_sensor_does_not_read_stands_on_the_table():
    """Stereo loses readings on what is black, and a band beside each edge."""
    seen, ids = look([Box(0.0, 0.0, (0.1, 0.1, 0.15))], camera_above(0.6, 0.7))
    view = find_table(seen, np.random.default_rng(0))
    assert not isinstance(view, Dropped), view
    foot = (ids == 2) & (view.heights < 0.06)
    unread = foot | (ndimage.binary_dilation(ids == 2, iterations=8) & (ids != 2))
    view = find_table(replace(seen, depth=np.where(unread, 0, seen.depth)), np.random.default_rng(0))
    assert not isinstance(view, Dropped), view
    assert keep_objects((ids == 2).astype(np.int32), view).max() == 1
