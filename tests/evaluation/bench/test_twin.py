"""The comparison of a scene with its photograph: a perfect twin, and twins with one thing wrong."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.bench.twin import TwinScore, TwinThing, compare_files, summarize_twins
from tableverse_factory.evaluation.bench.twin_views import draw_difference, render_twin
from tableverse_factory.sources.capture import Capture
from tests.helpers.photographed_scene import box_and_ball
from tests.helpers.tabletop_views import Box, camera_above, look

MOVED_PX = 40


@pytest.fixture(scope="module")
def files():
    return dict(box_and_ball(photographed=True).files)


@pytest.fixture(scope="module")
def view(files):
    return render_twin(files, json.loads(files["meta.json"]), "scene")


def with_masks(files, ids):
    return {**files, "observation/masks.png": encode(ids)}


def encode(ids):
    import io

    file = io.BytesIO()
    Image.fromarray(ids.astype(np.uint16)).save(file, "PNG")
    return file.getvalue()


def photograph(view):
    """A capture that is exactly what the twin shows."""
    return Capture(view.color, view.depth, view.eye.camera, None, None)


def compare(files, capture, folder):
    row = ImageRow(scene_id="scene", kind=SceneKind.CAPTURE, uri=str(folder), name="scene")
    return compare_files(row, capture, files, Config())[0]


def test_a_twin_of_itself_is_perfect(files, view, tmp_path):
    score = compare(with_masks(files, view.ids), photograph(view), tmp_path)
    assert [thing.twin for thing in score.things] == ["obj_000", "obj_001"]
    assert score.number == 1.0
    assert {thing.depth_error_m for thing in score.things} == {0.0}
    assert {thing.color_difference for thing in score.things} == {0.0}
    assert (score.extra, score.truth, score.reason) == (0, False, "")


def test_a_thing_without_twin_counts_as_zero(files, view, tmp_path):
    ids = np.array(view.ids)
    ids[:40, :40] = 9
    score = compare(with_masks(files, ids), photograph(view), tmp_path)
    assert [thing.silhouette_iou for thing in score.things] == [1.0, 1.0, 0.0]
    assert score.number == pytest.approx(2 / 3)


def test_a_displaced_thing_loses_silhouette_and_not_its_neighbours(files, view, tmp_path):
    ids = np.where(view.ids == 1, 1, 0) + np.roll(np.where(view.ids == 2, 2, 0), MOVED_PX, axis=1)
    score = compare(with_masks(files, ids), photograph(view), tmp_path)
    assert score.things[0].silhouette_iou == 1.0
    assert score.things[1].silhouette_iou < 0.7


def test_depth_and_colour_are_measured_on_the_things(files, view, tmp_path):
    farther = np.where(view.depth > 0, view.depth + np.float32(0.005), 0).astype(np.float32)
    other = np.where((view.ids == 2)[..., None], 255 - view.color, view.color).astype(np.uint8)
    capture = replace(photograph(view), depth=farther, color=other)
    score = compare(with_masks(files, view.ids), capture, tmp_path)
    assert [thing.depth_error_m for thing in score.things] == pytest.approx([0.005, 0.005], abs=1e-6)
    assert score.things[0].color_difference == 0.0
    assert score.things[1].color_difference > 5.0


def test_true_masks_count_and_match_by_overlap_whatever_their_numbers(files, view, tmp_path):
    truth = np.array([0, 30, 20], dtype=np.int32)[view.ids]
    truth[:30, :30] = 5
    Image.fromarray(truth.astype(np.uint16)).save(tmp_path / "masks.png")
    score = compare(with_masks(files, view.ids), photograph(view), tmp_path)
    assert [(thing.twin, thing.silhouette_iou) for thing in score.things] == [
        ("", 0.0),
        ("obj_001", 1.0),
        ("obj_000", 1.0),
    ]
    assert (score.truth, score.extra) == (True, 0)


def test_what_the_sensor_did_not_measure_is_no_surplus(files, view, tmp_path):
    ids, depth = np.array(view.ids), np.array(view.depth)
    half = ids.shape[1] // 2
    ids[:, :half] = 0
    blind = replace(photograph(view), depth=np.where(np.arange(ids.shape[1]) < half, 0, depth).astype(np.float32))
    measured = compare(with_masks(files, ids), photograph(view), tmp_path)
    unmeasured = compare(with_masks(files, ids), blind, tmp_path)
    assert unmeasured.number == 1.0
    assert measured.number < unmeasured.number


def test_a_scene_without_masks_is_refused():
    files = dict(box_and_ball(photographed=False).files)
    with pytest.raises(InputError, match=r"no camera of a photograph in meta.json"):
        render_twin(files, json.loads(files["meta.json"]), "scene")


def test_the_difference_names_what_is_missing_surplus_and_other():
    grey = np.full((1, 4, 3), 100, dtype=np.uint8)
    things, shown = np.array([[1, 0, 1, 1]]), np.array([[0, 1, 2, 1]])
    red, blue, orange, same = draw_difference(grey, things, shown)[0].astype(int)
    assert red[0] > red[2] > 0
    assert blue[2] > blue[0]
    assert orange[0] > orange[1] > orange[2]
    assert same.tolist() == [100, 100, 100]


def test_medians_are_over_things_and_lost_ones_have_no_errors():
    scores = [
        TwinScore("a", (TwinThing("x", 0.9, 0.001, 2.0), TwinThing("y", 0.7, 0.003, 4.0))),
        TwinScore("b", (TwinThing(),), reason="no_objects: nothing"),
    ]
    together = summarize_twins(scores)
    assert together["twin"] == pytest.approx(1.6 / 3)
    assert together["silhouette_iou"] == 0.7
    assert together["depth_error_m"] == pytest.approx(0.002)
    assert (together["lost"], together["scenes"], together["captures"]) == (1, 1, 2)


def test_the_command_computes_the_scene_of_a_capture_and_draws_it(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    capture = tmp_path / "captures" / "two"
    capture.mkdir(parents=True)
    boxes = [Box(-0.12, 0.0, (0.12, 0.09, 0.1)), Box(0.1, 0.05, (0.08, 0.1, 0.07), color=(40, 90, 200))]
    observation, _ = look(boxes, camera_to_table=camera_above(0.7, 0.5, 52.0))
    Image.fromarray(np.asarray(observation.color)).save(capture / "color.png")
    Image.fromarray(np.round(1000 * observation.depth).astype(np.uint16)).save(capture / "depth.png")
    camera = {key: getattr(observation.camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")}
    (capture / "camera.json").write_text(json.dumps(camera | {"depth_scale": 0.001}))
    pictures = tmp_path / "pictures"
    arguments = ["bench", "twin", str(capture.parent), "--pictures", str(pictures), "--jobs", "1", "--json"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    together = json.loads(result.stdout)["together"]
    assert (together["things"], together["lost"]) == (2, 0)
    assert together["twin"] > 0.9
    assert together["depth_error_m"] < 0.003
    assert together["explained_area"] > 0.98
    with Image.open(pictures / "two.jpg") as picture:
        assert picture.width > 3 * 640
