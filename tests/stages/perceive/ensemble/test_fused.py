"""Depth and the net together: either parts what the other joins, and pixels without a reading follow their region."""

import math

import numpy as np
import pytest

from tableverse_factory.stages.perceive.ensemble.fused import (
    AFFINITY_WEIGHT,
    MERGED_BELOW,
    _add_unmeasured,
    _measure_strength,
)


@pytest.mark.parametrize(
    ("depth", "logit", "joined"),
    [(0.0, 0.0, True), (2.0, 0.0, False), (0.0, -5.0, False), (2.0, 5.0, True), (MERGED_BELOW, 0.1, True)],
    ids=["neither sees a border", "a step", "a seam", "a crease of one thing", "no depth: the net decides"],
)
def test_the_stronger_evidence_decides(depth: float, logit: float, joined: bool) -> None:
    assert (_measure_strength((10 * depth, 10, 4 * logit, 4), 100, 100) <= MERGED_BELOW) is joined


def test_borders_add_up_and_what_does_not_touch_stays_apart() -> None:
    one, two = (6.0, 4.0, -3.0, 2.0), (2.0, 6.0, 9.0, 6.0)
    both = tuple(a + b for a, b in zip(one, two, strict=True))
    assert _measure_strength(both, 9, 9) == pytest.approx(0.8 - AFFINITY_WEIGHT * 0.75)
    assert _measure_strength((0.0, 0.0, 50.0, 10.0), 9, 9) == math.inf


def test_pixels_without_a_reading_follow_what_their_region_became() -> None:
    before = np.array([[1, 1, 1, 2, 2, 3, 3, 0]], dtype=np.int32)
    measured = np.array([[True, True, False, True, False, True, False, False]])
    after = np.array([[4, 4, 0, 4, 0, 0, 0, 0]], dtype=np.int32)  # 3 was no object
    assert _add_unmeasured(after, before, measured).tolist() == [[4, 4, 4, 4, 4, 0, 0, 0]]
