"""Depth and the net together: either parts what the other joins, and pixels without a reading follow their region."""

import math

import numpy as np
import pytest

from schemas.geometry import Camera
from tableverse_factory.models.picture.predict import PicturePrediction
from tableverse_factory.stages.perceive.base.table_view import ImageWindow
from tableverse_factory.stages.perceive.depth_segmenter.oversegment import Link
from tableverse_factory.stages.perceive.depth_segmenter.surface import compute_surface
from tableverse_factory.stages.perceive.ensemble.fused import (
    AFFINITY_WEIGHT,
    FUSED_BELOW,
    _add_unmeasured,
    _measure_strength,
    _merge_patches,
)


@pytest.mark.parametrize(
    ("depth", "logit", "joined"),
    [(0.0, 0.0, True), (2.0, 0.0, False), (0.0, -5.0, False), (2.0, 5.0, True), (FUSED_BELOW, 0.1, True)],
    ids=["neither sees a border", "a step", "a seam", "a crease of one thing", "no depth: the net decides"],
)
def test_the_stronger_evidence_decides(depth: float, logit: float, joined: bool) -> None:
    assert (_measure_strength(Link(10 * depth, 10, 4 * logit, 4), 100, 100) <= FUSED_BELOW) is joined


def test_borders_add_up_and_what_does_not_touch_stays_apart() -> None:
    one, two = Link(6.0, 4.0, -3.0, 2.0), Link(2.0, 6.0, 9.0, 6.0)
    both = Link(*(a + b for a, b in zip(one, two, strict=True)))
    assert _measure_strength(both, 9, 9) == pytest.approx(0.8 - AFFINITY_WEIGHT * 0.75)
    assert _measure_strength(Link(0.0, 0.0, 50.0, 10.0), 9, 9) == math.inf


def test_pixels_without_a_reading_follow_what_their_region_became() -> None:
    before = np.array([[1, 1, 1, 2, 2, 3, 3, 0]], dtype=np.int32)
    measured = np.array([[True, True, False, True, False, True, False, False]])
    after = np.array([[4, 4, 0, 4, 0, 0, 0, 0]], dtype=np.int32)  # 3 was no object
    assert _add_unmeasured(after, before, measured).tolist() == [[4, 4, 4, 4, 4, 0, 0, 0]]


@pytest.mark.parametrize(("logit", "count"), [(-0.2, 2), (0.2, 1)])
@pytest.mark.parametrize("width", range(12, 44, 4))
def test_where_depth_is_unknown_the_net_decides_alone(logit: float, count: int, width: int) -> None:
    shape = (24, width)
    camera = Camera(60.0, 60.0, width / 2, 12.0, width, 24)
    patches = np.where(np.arange(width) < width // 2, 1, 2).astype(np.int32) * np.ones(shape, np.int32)
    flat = np.zeros(shape, np.float32)
    seen = PicturePrediction(
        camera, flat, np.zeros((3, *shape), np.float32), np.zeros((2, *shape), np.float32), flat,
        np.full((6, *shape), logit, np.float32), np.array([0.0, 0.0, -1.0]), 0.5, 1.0, 0.1,
    )  # fmt: skip
    surface = compute_surface(np.zeros(shape), camera, 0.5)
    merged = _merge_patches(patches, surface, seen, ImageWindow(0, 0, *shape, 1), shape)
    assert len(np.unique(merged)) == count


@pytest.mark.parametrize("count", range(1, 60))
def test_a_border_of_which_nothing_is_known_parts_nothing(count: int) -> None:
    total = math.fsum([FUSED_BELOW] * count)
    assert _measure_strength(Link(total, float(count)), 9, 9) <= FUSED_BELOW
    assert _measure_strength(Link(sum([FUSED_BELOW] * count), float(count)), 9, 9) <= FUSED_BELOW
