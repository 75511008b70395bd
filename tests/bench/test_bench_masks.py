"""The score of masks against ground truth, counted by hand."""

import numpy as np
import pytest

from schemas.config import Config
from tableverse_factory.bench.perception import bench_masks, compare_masks, together, without_table
from tableverse_factory.errors import InputError


def ids(*rows):
    return np.array(rows, dtype=np.int32)


def test_a_perfect_answer_with_other_numbers_scores_one():
    truth = ids([1, 1, 0, 2], [1, 1, 0, 2])
    score = compare_masks("a", truth, ids([7, 7, -1, 3], [7, 7, -1, 3]), 0.1)
    assert (score.mean_iou, score.recall, score.overlap_f) == (1.0, 1.0, 1.0)
    assert (score.found, score.truth) == (2, 2)


def test_scores_are_as_counted_by_hand():
    truth = ids([1, 1, 1, 1, 2, 2])
    score = compare_masks("a", truth, ids([5, 5, 5, 6, 6, 0]), 0.1)
    assert score.ious == pytest.approx((3 / 4, 1 / 3))
    assert score.recall == 0.5
    assert score.overlap_f == pytest.approx(2 * (3 + 1) / (6 + 5))


def test_one_region_over_two_objects_counts_for_one_of_them():
    score = compare_masks("a", ids([1, 1, 1, 2, 2]), ids([4, 4, 4, 4, 4]), 0.1)
    assert score.ious == pytest.approx((0.6, 0.4))
    assert score.overlap_f == pytest.approx(2 * 3 / 10)


def test_what_the_truth_does_not_know_costs_no_precision():
    score = compare_masks("a", ids([1, 1, 0, 0]), ids([1, 1, 0, 9]), 0.1)
    assert score.overlap_f == 1.0
    assert score.found == 2


def test_finding_nothing_scores_nothing():
    score = compare_masks("a", ids([1, 1, 2]), ids([0, -1, 0]), 0.1)
    assert (score.mean_iou, score.recall, score.overlap_f, score.found) == (0.0, 0.0, 0.0, 0)


def test_the_mean_is_over_objects_and_not_over_captures():
    scores = [
        compare_masks("a", ids([1, 2, 3]), ids([1, 2, 3]), 1.0),
        compare_masks("b", ids([1, 0, 0]), ids([0, 0, 0]), 3.0),
    ]
    assert together(scores).mean_iou == 0.75
    assert together(scores).cpu_s == 2.0


def test_the_table_is_no_object_where_the_truth_numbers_it():
    truth = ids([1, 1, 1, 1, 2, 2])
    assert without_table(truth, ids([-1, -1, -1, 0, 1, 1])).tolist() == [[0, 0, 0, 0, 2, 2]]
    assert without_table(truth, ids([3, 3, 3, -1, 1, 1])).tolist() == truth.tolist()


def test_a_folder_without_truth_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"seg\.png or masks\.png"):
        list(bench_masks(tmp_path, Config()))
