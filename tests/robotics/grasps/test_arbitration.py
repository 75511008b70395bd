"""The three stages: what each may keep, and that no other grasp is ever lost or preferred."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.trajectories import Grasps
from tableverse_factory.robotics.grasps.arbitration import arbitrate

heights = st.one_of(st.floats(-1.0, 1.0), st.sampled_from([-1.0, -0.9, -1e-9, 0.0, 1.0]))
scored = st.tuples(heights, st.floats(0.0, 1.0))


def grasps_of(rows) -> Grasps:
    """Grasps whose approaches have these vertical parts; their position tells them apart."""
    count = len(rows)
    rotations = np.zeros((count, 3, 3))
    for index, (down, _) in enumerate(rows):
        side = np.sqrt(max(0.0, 1.0 - down * down))
        approach, closing = np.array([side, 0.0, down]), np.array([0.0, 1.0, 0.0])
        rotations[index] = np.column_stack([np.cross(closing, approach), closing, approach])
    positions = np.column_stack([np.arange(count, dtype=float), np.zeros(count), np.zeros(count)])
    return Grasps(rotations, positions, np.full(count, 0.04), np.array([score for _, score in rows], dtype=float))


@given(st.lists(scored, max_size=30), st.floats(-1.0, -0.01))
def test_each_stage_keeps_exactly_what_the_paper_says(rows, gamma):
    kept, stage = arbitrate(grasps_of(rows), gamma)
    strict = [k for k, (down, _) in enumerate(rows) if down <= gamma]
    downward = [k for k, (down, _) in enumerate(rows) if down < 0.0]
    chosen = kept.positions[:, 0].astype(int).tolist()
    if strict:
        assert (stage, sorted(chosen)) == (1, strict)
    elif downward:
        assert (stage, sorted(chosen)) == (2, downward)
    elif rows:
        assert stage == 3
        assert chosen == [int(np.argmax([score for _, score in rows]))]
    else:
        assert (stage, chosen) == (0, [])


@given(st.lists(scored, min_size=1, max_size=30))
def test_the_best_comes_first_and_equals_keep_their_order(rows):
    kept, _ = arbitrate(grasps_of(rows), -0.9)
    keys = [(-score, index) for score, index in zip(kept.scores, kept.positions[:, 0], strict=True)]
    assert keys == sorted(keys)


@given(st.lists(scored, min_size=1, max_size=30), st.randoms(use_true_random=False))
def test_order_does_not_matter_where_scores_differ(rows, random):
    rows = [(down, index / 100) for index, (down, _) in enumerate(rows)]
    shuffled = rows[:]
    random.shuffle(shuffled)
    (one, stage), (other, same_stage) = (arbitrate(grasps_of(order), -0.8) for order in (rows, shuffled))
    assert stage == same_stage
    assert one.scores.tolist() == other.scores.tolist()


@pytest.mark.heavy
@given(st.lists(scored, min_size=1, max_size=30))
def test_a_wider_cone_never_loses_a_grasp_within_a_stage(rows):
    narrow, first = arbitrate(grasps_of(rows), -0.95)
    wide, second = arbitrate(grasps_of(rows), -0.5)
    if first == second and first != 3:
        assert set(narrow.positions[:, 0]) <= set(wide.positions[:, 0])
    assert second <= first


@pytest.mark.parametrize(("down", "stage"), [(-0.9, 1), (-0.89, 2), (-1e-12, 2), (0.0, 3), (0.5, 3)])
def test_the_borders_belong_where_the_paper_puts_them(down, stage):
    assert arbitrate(grasps_of([(down, 0.3)]), -0.9)[1] == stage
