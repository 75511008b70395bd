"""How much of what stands above the table is explained: boxes of known size, some of them left out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from schemas.config import Config, PerceiveConfig
from schemas.detection import Detection, Detections
from schemas.objects import Explanation, PerceivedObject
from schemas.outcome import Done, Dropped
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.explanation import measure_explanation
from tableverse_factory.stages.perceive.perceive import perceive
from tableverse_factory.stages.perceive.table import find_table
from tests.helpers.tabletop_views import Box, camera_above, look

BOXES = [Box(x, y, (0.1, 0.1, 0.1)) for x, y in ((-0.2, -0.1), (0.2, -0.1), (-0.2, 0.12), (0.2, 0.12))]
ABOVE = camera_above(0.9, 0.5, 60.0)


def photograph(known, things=BOXES, **scenery):
    """An observation whose recorded masks hold the first `known` things only."""
    observation, truth = look(things, camera_to_table=ABOVE, **scenery)
    ids = np.where((truth > 1) & (truth <= known + 1), truth - 1, 0).astype(np.int32)
    boxes = tuple(
        Detection(label="box", bbox_xyxy=(0.0, 0.0, 1000.0, 1000.0), instance_id=k) for k in range(1, known + 1)
    )
    return replace(observation, recorded_detections=Detections(detections=boxes), recorded_ids=ids), ids


def explain(known, things=BOXES, **scenery) -> tuple[Explanation, int]:
    observation, ids = photograph(known, things, **scenery)
    view = find_table(observation, np.random.default_rng(0))
    points = np.zeros((0, 3))
    objects = [PerceivedObject(f"obj_{k}", k, "box", 1.0, points, points.astype(np.uint8)) for k in range(1, known + 1)]
    return measure_explanation(view, ids, objects), int((ids > 0).sum())


def find(known, **keys):
    observation, _ = photograph(known)
    config = Config(perceive=PerceiveConfig(**keys))
    return perceive(observation, config, np.random.default_rng(0), Services(Path("unused")))


def test_objects_that_cover_all_explain_all():
    found, pixels = explain(4)
    assert found.measure_shares({"obj_1", "obj_2", "obj_3", "obj_4"}) == (1.0, 1.0)
    assert found.points == pytest.approx(pixels, rel=0.05)


def test_a_lost_object_leaves_its_share_unexplained():
    found, _ = explain(3)
    whole, _ = explain(4)
    lost = 1 - {name: points for name, points, _ in whole.of_objects}["obj_4"] / whole.points
    assert found.measure_shares({"obj_1", "obj_2", "obj_3"})[0] == pytest.approx(lost, abs=1e-6)
    assert whole.measure_shares({"obj_1", "obj_2", "obj_3"})[0] == pytest.approx(lost, abs=1e-6)


def test_a_wall_and_what_stands_on_the_floor_need_no_explanation():
    beside = Box(0.75, 0.0, (0.2, 0.4, 0.5), z=-0.4)
    found, _ = explain(4, [*BOXES, beside], wall_y=0.5, floor_z=-0.4)
    assert found.measure_shares({"obj_1", "obj_2", "obj_3", "obj_4"})[1] > 0.98


@pytest.mark.parametrize("gap_m", [0.05, pytest.param(0.0, marks=pytest.mark.slow)])
def test_a_wall_on_the_tables_edge_and_a_rail_before_it_need_no_explanation(gap_m):
    wall, rail = Box(0.0, 0.51, (2.0, 0.1, 0.7)), Box(0.0, 0.44 - gap_m, (0.8, 0.04, 0.05), z=0.15)
    areas = []
    for things in (BOXES[:2], [*BOXES[:2], wall, rail]):
        observation, truth = look(things, camera_above(0.9, 0.8, 42.0), noise_m=0.001, table_half=(0.6, 0.46))
        view = find_table(observation, np.random.default_rng(0))
        areas.append(measure_explanation(view, np.zeros_like(truth), []).area_m2)
    assert areas[1] == pytest.approx(areas[0], rel=0.02)


def test_what_stands_behind_a_pile_counts_though_the_outline_of_the_table_ends_there():
    observation, ids = photograph(2)
    view = find_table(observation, np.random.default_rng(0))
    (left, near), (right, far) = view.outline_xy.min(axis=0), view.outline_xy.max(axis=0)
    end = left + 0.4 * (right - left)
    short = replace(view, outline_xy=np.array([[left, near], [end, near], [end, far], [left, far]]))
    assert measure_explanation(short, ids, []).points == pytest.approx(
        measure_explanation(view, ids, []).points, rel=0.02
    )


def test_nothing_above_the_table_is_wholly_explained():
    empty = Explanation(0, 0.0, ())
    assert empty.measure_shares(set()) == (1.0, 1.0)
    assert empty.describe_shortfall(set(), 1.0) == ""


def test_a_capture_of_which_half_the_masks_are_missing_is_dropped_with_the_figures():
    outcome = find(2)
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "too_little_explained"
    assert "objects found: 2; they explain 49%" in outcome.detail
    assert "at least 65%" in outcome.detail


def test_the_bound_is_the_callers_and_the_shares_travel():
    outcome = find(2, min_explained=0.3)
    assert isinstance(outcome, Done)
    names = {item.object_id for item in outcome.value.objects}
    assert 0.3 < outcome.value.explanation.measure_shares(names)[1] < 0.65
    complete = find(4)
    assert isinstance(complete, Done)
