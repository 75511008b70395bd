"""The score of masks against ground truth, counted by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from schemas.config import Config
from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.bench.perception import (
    Containment,
    bench_masks,
    compare_masks,
    compare_pairs,
    mark_unlabelled,
    merge_scores,
    read_true_pairs,
    remove_table,
    remove_unlabelled,
)
from tests.helpers.tabletop_views import Bowl, Box, camera_above, look


def ids(*rows):
    return np.array(rows, dtype=np.int32)


def write_look(folder, things, contained_in):
    """A capture with the truth beside it: ids from 1 in the order of the things."""
    observation, truth = look(things, camera_to_table=camera_above(0.7, 0.5, 52.0))
    folder.mkdir()
    Image.fromarray(np.asarray(observation.color)).save(folder / "color.png")
    Image.fromarray(np.round(1000 * observation.depth).astype(np.uint16)).save(folder / "depth.png")
    Image.fromarray(np.maximum(truth - 1, 0).astype(np.uint16)).save(folder / "masks.png")
    camera = {key: getattr(observation.camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")}
    (folder / "camera.json").write_text(json.dumps(camera | {"depth_scale": 0.001}))
    entries = [{"instance_id": k, "contained_in": contained_in.get(k)} for k in range(1, len(things) + 1)]
    (folder / "truth.json").write_text(json.dumps({"objects": entries}))


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


def test_pixels_that_a_truth_drawn_on_the_depth_cannot_label_count_for_neither_side():
    truth, found = ids([1, 1, 0, 0, 0]), ids([4, 4, 4, 0, 5])
    marked = mark_unlabelled(truth, np.array([[0.7, 0.7, 0.0, 0.7, 0.7]]))
    kept = remove_unlabelled(marked, found)
    score = compare_masks("a", marked, kept, 0.1)
    assert (score.mean_iou, score.overlap_f) == (1.0, 1.0)
    assert score.found == 2, "the other object lies where the truth says that there is none"
    drawn_on_color = mark_unlabelled(truth, np.array([[0.7, 0.0, 0.0, 0.7, 0.7]]))
    assert compare_masks("a", drawn_on_color, remove_unlabelled(drawn_on_color, found), 0.1).mean_iou == 2 / 3


def test_objects_are_matched_by_labelled_pixels_alone(tmp_path):
    """A box whose sides lie beyond the sensor's range is larger than its truth, and its twin is still its match."""
    capture = tmp_path / "boxes"
    write_look(capture, [Box(-0.12, 0.05, (0.1, 0.06, 0.15)), Box(0.15, -0.05, (0.08, 0.08, 0.08))], {})
    depth = np.array(Image.open(capture / "depth.png"))
    masks = np.array(Image.open(capture / "masks.png"))
    left = (masks == 1) & (np.arange(masks.shape[1]) < np.flatnonzero((masks == 1).any(axis=0)).mean())
    depth[left], masks[left] = 0, 0
    Image.fromarray(depth).save(capture / "depth.png")
    Image.fromarray(masks).save(capture / "masks.png")
    whole = next(iter(bench_masks(tmp_path, Config())))
    assert whole.mean_iou > 0.9
    assert whole.found == whole.truth == 2


def test_finding_nothing_scores_nothing():
    score = compare_masks("a", ids([1, 1, 2]), ids([0, -1, 0]), 0.1)
    assert (score.mean_iou, score.recall, score.overlap_f, score.found) == (0.0, 0.0, 0.0, 0)


def test_the_mean_is_over_objects_and_not_over_captures():
    scores = [
        compare_masks("a", ids([1, 2, 3]), ids([1, 2, 3]), 1.0),
        compare_masks("b", ids([1, 0, 0]), ids([0, 0, 0]), 3.0),
    ]
    assert merge_scores(scores).mean_iou == 0.75
    assert merge_scores(scores).cpu_s == 2.0


def test_the_table_is_no_object_where_the_truth_numbers_it():
    truth = ids([1, 1, 1, 1, 2, 2])
    assert remove_table(truth, ids([-1, -1, -1, 0, 1, 1])).tolist() == [[0, 0, 0, 0, 2, 2]]
    assert remove_table(truth, ids([3, 3, 3, -1, 1, 1])).tolist() == truth.tolist()


def test_a_folder_without_truth_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"seg\.png or masks\.png"):
        list(bench_masks(tmp_path, Config()))


def test_a_capture_that_cannot_be_read_costs_the_others_nothing(tmp_path):
    for name, x in (("a", -0.12), ("b", 0.0), ("c", 0.12), ("my capture (1)", 0.05)):
        write_look(tmp_path / name, [Box(x, 0.05, (0.1, 0.06, 0.15))], {})
    Image.new("I;16", (8, 8)).save(tmp_path / "a" / "masks.png")
    Image.new("I;16", Image.open(tmp_path / "b" / "depth.png").size).save(tmp_path / "b" / "depth.png")
    scores = list(bench_masks(tmp_path, Config()))
    assert [score.unread for score in scores] == [True, True, False, False]
    assert "8 x 8" in scores[0].reason
    assert "depth_all_zero" in scores[1].reason
    assert merge_scores(scores).truth == 2
    for name in ("c", "my capture (1)"):
        (tmp_path / name / "truth.json").unlink()
    shown = CliRunner().invoke(app, ["bench", "twin", str(tmp_path), "--jobs", "1"])
    assert shown.exit_code == 0, shown.output
    assert "depth_all_zero" in shown.output
    assert "2 of 4 captures have a scene" in shown.output


def test_what_lies_in_what_is_counted_by_the_masks_and_not_by_the_numbers():
    truth, found = ids([1, 1, 1, 2, 3, 3]), ids([9, 9, 9, 4, 5, 5])
    true = {2: 1, 3: 1, 6: 1}  # the sixth thing is hidden
    assert compare_pairs(truth, found, true, {4: 9, 5: 4}) == Containment(2, 2, 1)
    assert compare_pairs(truth, found, true, {9: 4}).correct == 0, "the bowl is not in the fruit"
    none = compare_pairs(truth, np.zeros_like(truth), true, {})
    assert (none.recall, none.found) == (0.0, 0)
    assert np.isnan(none.precision)


def test_pairs_of_all_captures_are_added_where_they_are_known():
    scores = [compare_masks(name, ids([1]), ids([1]), 1.0) for name in "abc"]
    known = [
        replace(s, containment=c) for s, c in zip(scores, (Containment(3, 1, 1), Containment(1, 2, 1)), strict=False)
    ]
    total = merge_scores([*known, scores[2]]).containment
    assert (total.true, total.precision, total.recall) == (4, 2 / 3, 0.5)
    assert merge_scores(scores).containment is None


def test_a_truth_that_does_not_say_what_lies_in_what_is_refused(tmp_path):
    assert read_true_pairs(tmp_path) is None
    (tmp_path / "truth.json").write_text('{"objects": [{"instance_id": 2, "contained_in": 1}]}')
    assert read_true_pairs(tmp_path) == {2: 1}
    (tmp_path / "truth.json").write_text('{"objects": [{"instance_id": 2}]}')
    with pytest.raises(InputError, match="what lies in what"):
        read_true_pairs(tmp_path)


@pytest.mark.heavy
def test_the_command_says_what_lies_in_what_in_json(tmp_path):
    bowl, block = Bowl(0.0, 0.0, 0.09), Box(0.0, 0.01, (0.045, 0.045, 0.06), z=0.012, color=(230, 200, 40))
    write_look(tmp_path / "a", [bowl, block], contained_in={2: 1})
    (tmp_path / "untold").mkdir()
    (tmp_path / "untold" / "color.png").write_bytes((tmp_path / "a" / "color.png").read_bytes())
    said = CliRunner().invoke(app, ["bench", "perception", str(tmp_path)]).stderr
    assert "without seg.png or masks.png: untold" in said
    result = CliRunner().invoke(app, ["bench", "perception", str(tmp_path), "--json"])
    assert result.exit_code == 0, result.output
    said = json.loads(result.stdout)
    assert [row["name"] for row in said["captures"]] == ["a"]
    for row in (*said["captures"], said["together"]):
        assert row["containment"] == {"true": 1, "found": 1, "correct": 1, "precision": 1.0, "recall": 1.0}
