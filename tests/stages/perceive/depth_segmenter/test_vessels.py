"""Vessels by their rims: found where they are, nowhere else, whole around their contents, and holding them."""

import numpy as np
import pytest

from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.depth_segmenter.rims import BESIDE_M, find_rims
from tableverse_factory.stages.perceive.depth_segmenter.segment import segment_depth
from tableverse_factory.stages.perceive.perceive import perceive
from tableverse_factory.stages.perceive.table import find_table
from tests.helpers.tabletop_views import GEOMETRIC, Bowl, Box, best_overlaps, camera_above, look

pytestmark = pytest.mark.heavy

GREEN, YELLOW = (40, 160, 60), (230, 200, 40)
LOW = camera_above(0.45, 0.6, 38.0)
PARTING = Box(0.0, 0.0, (0.15, 0.03, 0.1), z=0.02, color=YELLOW)
"""From wall to wall of a bowl, and higher than its rim: the near wall and the far one touch nowhere in the picture."""


def seen(things, noise_m=0.0):
    observation, truth = look(things, camera_to_table=LOW, noise_m=noise_m)
    return observation, find_table(observation, np.random.default_rng(0)), truth


@pytest.mark.parametrize("noise_m", [0.0, 0.0012])
def test_a_rim_is_found_where_it_is(noise_m):
    _, view, truth = seen([Bowl(0.05, 0.02, 0.09), PARTING], noise_m)
    (rim,) = find_rims(np.where(truth > 1, truth - 1, 0).astype(np.int32), view)
    assert rim.radius == pytest.approx(0.09, abs=0.003)
    assert rim.height == pytest.approx(0.09, abs=0.004)
    assert rim.floor < 0.06
    wall = view.xy(view.points_camera)[truth == 2]
    assert float(rim.distance(wall).max()) < 0.095, "its middle is the bowl's"
    elsewhere = np.ones(truth.shape, dtype=bool)
    elsewhere[rim.window] = False
    off = rim.distance(view.xy(view.points_camera))
    assert elsewhere.any()
    assert not (elsewhere & (rim.within | (off < rim.radius + BESIDE_M))).any(), "only the window is looked at"


def test_a_rim_does_not_depend_on_the_numbers_of_other_regions():
    _, view, truth = seen([Bowl(0.05, 0.02, 0.09), PARTING], 0.004)
    found = [find_rims(np.array(numbers, dtype=np.int32)[truth], view)[0] for numbers in ((0, 0, 1, 2), (0, 0, 2, 1))]
    assert found[0].center.tolist() == found[1].center.tolist()
    assert (found[0].radius, found[0].height) == (found[1].radius, found[1].height)


def test_solid_things_have_no_rim():
    things = [
        Box(0.0, 0.0, (0.12, 0.12, 0.1)),
        Box(0.15, 0.1, (0.06, 0.06, 0.18), yaw=0.7),
        Box(-0.2, 0.0, (0.1, 0.2, 0.02)),
    ]
    _, view, truth = seen(things, 0.0012)
    assert find_rims(np.where(truth > 1, truth - 1, 0).astype(np.int32), view) == []


@pytest.mark.parametrize("noise_m", [0.0, 0.0012])
def test_a_bowl_is_whole_although_its_contents_part_it(tmp_path, noise_m):
    observation, _, truth = seen([Bowl(0.0, 0.0, 0.09), PARTING], noise_m)
    found = perceive(observation, GEOMETRIC, np.random.default_rng(0), Services(tmp_path)).value
    assert len(found.objects) == 2
    assert min(best_overlaps(truth, found.instance_ids)) > 0.85
    content = next(o for o in found.objects if o.contained_in is not None)
    assert (found.instance_ids[truth == 3] == content.instance_id).mean() > 0.9


def test_what_rises_out_of_a_bowl_is_in_it_and_what_stands_behind_is_not():
    stick, behind = (
        Box(0.03, 0.03, (0.02, 0.02, 0.25), z=0.02, color=GREEN),
        Box(-0.04, 0.14, (0.05, 0.04, 0.2), color=YELLOW),
    )
    _, view, truth = seen([Bowl(0.0, 0.0, 0.09), stick, behind])
    ids, holders = segment_depth(view)
    bowl, inner, other = (int(np.bincount(ids[(truth == k) & (ids > 0)]).argmax()) for k in (2, 3, 4))
    assert len({bowl, inner, other}) == 3
    assert holders == {inner: bowl}


def test_a_thin_stick_in_a_bowl_is_kept_and_as_small_a_lump_on_the_table_is_not():
    stick, lump = Box(0.02, 0.02, (0.006, 0.006, 0.11), z=0.02, color=GREEN), Box(0.2, 0.0, (0.012, 0.012, 0.012))
    _, view, truth = seen([Bowl(0.0, 0.0, 0.07), stick, lump], 0.0006)
    ids, holders = segment_depth(view)
    assert list(holders) == [int(np.bincount(ids[(truth == 3) & (ids > 0)]).argmax())]
    assert int((ids[truth == 4] > 0).sum()) == 0


def test_a_tall_box_beside_a_low_one_lies_not_in_it():
    low, tall = Box(0.0, 0.0, (0.2, 0.2, 0.08), yaw=0.5), Box(0.1, 0.11, (0.06, 0.06, 0.2))
    _, view, _ = seen([low, tall])
    ids, holders = segment_depth(view)
    assert ids.max() == 2
    assert holders == {}


def test_a_handle_at_the_rim_is_the_vessels_and_a_stick_across_it_is_not():
    handle = Box(0.128, 0.0, (0.13, 0.02, 0.012), z=0.052, color=GREEN)
    across = Box(-0.076, 0.0, (0.02, 0.13, 0.012), z=0.052, color=YELLOW)
    _, view, truth = seen([Bowl(0.0, 0.0, 0.06), handle, across], 0.0006)
    ids, _ = segment_depth(view)
    bowl, pan, other = (int(np.bincount(ids[(truth == k) & (ids > 0)]).argmax()) for k in (2, 3, 4))
    assert bowl == pan
    assert bowl != other
