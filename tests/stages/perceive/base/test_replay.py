"""Recorded detections and masks: everything comes through, and what is untrusted is bounded."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from schemas.config import Config
from schemas.detection import Detections
from schemas.outcome import Done, Dropped
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.perceive import choose_detector, perceive
from tests.helpers.tabletop_views import GEOMETRIC, Bowl, Box, camera_above, look, overlap

pytestmark = pytest.mark.heavy

REPLAY = Config.model_validate({"perceive": {"detector": "replay", "min_explained": 0.0}})  # of some of the things


def box_of(mask):
    rows, columns = np.nonzero(mask)
    height, width = mask.shape
    return [
        columns.min() / width * 1000,
        rows.min() / height * 1000,
        (columns.max() + 1) / width * 1000,
        (rows.max() + 1) / height * 1000,
    ]


@pytest.fixture(scope="module")
def breakfast():
    """A bowl (2) with a block (3) in it, and a box (4); with its true ids."""
    things = [
        Bowl(-0.1, 0.0, 0.09),
        Box(-0.1, 0.01, (0.045, 0.045, 0.06), z=0.012, color=(230, 200, 40)),
        Box(0.15, 0.0, (0.1, 0.08, 0.12)),
    ]
    return look(things, camera_above(0.7, 0.5, 52.0))


def recorded(breakfast, with_ids=True, named=True):
    observation, truth = breakfast
    boxes = {k: box_of(truth == k) for k in (1, 2, 3, 4)}
    number = (lambda k: {"instance_id": k}) if named else (lambda k: {})
    detections = {
        "detections": [
            {"label": "table", "bbox_xyxy": boxes[1], "score": 0.9},
            {"label": 'cereal "/><x a="', "bbox_xyxy": boxes[4], "score": 0.8, **number(4)},
        ],
        "composites": [
            {
                "type": "container_fill",
                "container": {"label": "bowl", "bbox": boxes[2], **number(2)},
                "contents": [{"label": "biscuit", "bbox": boxes[3], "count": 3, **number(3)}],
            }
        ],
    }
    ids = np.where(truth > 1, truth, 0).astype(np.int32) if with_ids else None
    return replace(observation, recorded_detections=Detections.model_validate(detections), recorded_ids=ids)


def perceived(observation, config, tmp_path):
    outcome = perceive(observation, config, np.random.default_rng(0), Services(tmp_path))
    assert isinstance(outcome, Done), outcome
    return outcome.value


@pytest.mark.parametrize("named", [True, False], ids=["by instance id", "by box alone"])
def test_masks_labels_and_composites_come_through(breakfast, tmp_path, named):
    observation, truth = recorded(breakfast, named=named), breakfast[1]
    found = perceived(observation, Config(), tmp_path)
    assert found.perception == "replay"
    assert [(o.object_id, o.label, o.count, o.contained_in) for o in found.objects] == [
        ("obj_000", 'cereal "/><x a="', 1, None),
        ("obj_001", "bowl", 1, None),
        ("obj_002", "biscuit", 3, "obj_001"),
    ]
    assert [o.score for o in found.objects] == [0.8, 1.0, 1.0]
    for item, number in zip(found.objects, (4, 2, 3), strict=True):
        assert (found.instance_ids == item.instance_id).sum() == (truth == number).sum()
    assert not (found.instance_ids[truth > 1] == -1).any()


def test_boxes_without_masks_get_the_regions_inside_them(breakfast, tmp_path):
    found = perceived(recorded(breakfast, with_ids=False), REPLAY, tmp_path)
    truth = breakfast[1]
    assert {o.label for o in found.objects} == {'cereal "/><x a="', "bowl", "biscuit"}
    for item, number in zip(found.objects, (4, 2, 3), strict=True):
        assert overlap(found.instance_ids == item.instance_id, truth == number) > 0.7, item.label


def test_auto_replays_what_has_recorded_detections(breakfast):
    assert choose_detector(recorded(breakfast), Config().perceive) == "replay"
    assert choose_detector(recorded(breakfast, with_ids=False), Config().perceive) == "replay"
    assert choose_detector(breakfast[0], Config().perceive) == "ensemble"
    assert choose_detector(recorded(breakfast), GEOMETRIC.perceive) == "geometric"


def test_replay_without_a_recording_is_dropped(breakfast, tmp_path):
    outcome = perceive(breakfast[0], REPLAY, np.random.default_rng(0), Services(tmp_path))
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "no_recorded_detections"


def test_instances_that_the_masks_do_not_hold_are_left_out(breakfast, tmp_path):
    observation = recorded(breakfast)
    ids = np.array(observation.recorded_ids)
    ids[ids == 2] = 0
    found = perceived(replace(observation, recorded_ids=ids), REPLAY, tmp_path)
    assert [(o.label, o.contained_in) for o in found.objects] == [('cereal "/><x a="', None), ("biscuit", None)]
    assert [name for name, reason in found.left_out if "bowl" in reason] == ["obj_001"]


def test_swapped_and_empty_boxes_do_no_harm(breakfast, tmp_path):
    observation = recorded(breakfast, with_ids=False)
    wild = Detections.model_validate(
        {
            "detections": [
                {"label": "swapped", "bbox_xyxy": box_of(breakfast[1] == 4)[2:] + box_of(breakfast[1] == 4)[:2]},
                {"label": "empty", "bbox_xyxy": [500, 500, 500, 500]},
                {"label": "corner", "bbox_xyxy": [0, 0, 1, 1]},
            ]
        }
    )
    found = perceived(replace(observation, recorded_detections=wild), REPLAY, tmp_path)
    assert [o.label for o in found.objects] == ["swapped"]


def test_two_of_which_one_hides_in_the_others_region_share_its_pixels(breakfast, tmp_path):
    """Depth sees a heap and what holds it as one region: most of it is the heap's, the rest stays its container's."""
    observation, truth = breakfast
    x0, y0, x1, y1 = box_of(truth == 4)
    boxes = {
        "detections": [],
        "composites": [
            {
                "type": "container_fill",
                "container": {"label": "basket", "bbox": [x0 - 20, y0 - 20, x1 + 20, y1 + 20]},
                "contents": [{"label": "heap", "bbox": [x0, y0, x1, y0 + 0.75 * (y1 - y0)], "count": 1}],
            }
        ],
    }
    both = replace(observation, recorded_detections=Detections.model_validate(boxes))
    found = perceived(both, REPLAY, tmp_path)
    assert [(o.label, o.contained_in) for o in found.objects] == [("basket", None), ("heap", "obj_000")]
    basket, heap = (found.instance_ids == o.instance_id for o in found.objects)
    assert overlap(basket | heap, truth == 4) > 0.8
    assert heap.sum() > 1.5 * basket.sum()
    assert basket.sum() > 200


@pytest.mark.parametrize(
    "with_ids", [pytest.param(True, marks=pytest.mark.slow), False], ids=["with masks", "boxes alone"]
)
def test_two_hundred_things_take_no_memory_of_a_picture_each(breakfast, tmp_path, with_ids):
    observation = breakfast[0]
    rows, columns = np.indices(observation.depth.shape, dtype=np.int32)
    ids = 1 + rows // 48 * 20 + columns // 32  # 10 rows of 20

    def peak(count):
        cells = [divmod(k, 20) for k in range(count)]
        boxes = [{"bbox_xyxy": [50 * x, 100 * y, 50 * x + 50, 100 * y + 100], "label": "a"} for y, x in cells]
        asked = Detections.model_validate({"detections": boxes})
        seen = replace(observation, recorded_detections=asked, recorded_ids=ids if with_ids else None)
        tracemalloc.start()
        try:
            perceive(seen, REPLAY, np.random.default_rng(0), Services(tmp_path))
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    assert peak(200) - peak(10) < 20 * ids.size
