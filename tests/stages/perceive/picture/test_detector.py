"""A bare picture through `observe` and `perceive`: its table, its boxes, and where its metres come from."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from schemas.config import Config
from schemas.geometry import TABLE_ID, IdImage
from schemas.manifest import ImageRow, SceneKind
from schemas.objects import PerceivedObjects
from schemas.outcome import Done, Dropped, Outcome
from tableverse_factory.core.errors import ConfigError, ModelAccessError
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.models.picture.instances import upsample_ids
from tableverse_factory.models.picture.predict import OBJECT, TABLE, PicturePrediction
from tableverse_factory.models.services import Services
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures
from tableverse_factory.stages.observe.observe import observe
from tableverse_factory.stages.perceive.base.interfaces import Candidate, DetectionResult
from tableverse_factory.stages.perceive.perceive import perceive
from tableverse_factory.stages.perceive.picture.detector import (
    detect_in_picture,
    detect_predicted,
    find_standing,
    predict_view,
    segment_boxes_in_picture,
)
from tableverse_factory.stages.perceive.recorded import record_segmenter
from tableverse_factory.stages.perceive.table import find_table
from tests.helpers.tabletop_views import CAMERA, Box, best_overlaps, camera_above, look

THINGS = (Box(-0.12, 0.05, (0.1, 0.06, 0.15)), Box(0.15, -0.05, (0.08, 0.08, 0.08), color=(40, 90, 200)))
POSE = camera_above()  # 0.6 m over the table
HEIGHT = json.dumps({"kind": "camera_height", "length_m": 0.6})


@pytest.fixture(scope="module")
def view(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, IdImage]:
    """The colour of two boxes on a table in a room, with a camera's noise, and the true ids."""
    seen, ids = look(THINGS, POSE, floor_z=-0.7, wall_y=1.5)
    noise = np.random.default_rng(0).normal(0.0, 6.0, seen.color.shape)
    path = tmp_path_factory.mktemp("view") / "table.png"
    Image.fromarray(np.clip(seen.color + noise, 0, 255).astype(np.uint8)).save(path)
    return path, ids


def see(path: Path, known_length: str = "", **sections: dict[str, object]) -> Outcome[PerceivedObjects]:
    row = ImageRow(scene_id="x", kind=SceneKind.IMAGE, uri=str(path), known_length=known_length)
    own = {"min_table_probability": 0.5, **sections.get("observe", {})}  # plain boxes are no photograph of a table
    config = Config.model_validate({**sections, "observe": own})
    seen = observe(row, config, np.random.default_rng(0), Services(Path()))
    assert isinstance(seen, Done), seen
    return perceive(seen.value, config, np.random.default_rng(0), Services(Path()))


def find(path: Path, known_length: str = "", **sections: dict[str, object]) -> PerceivedObjects:
    outcome = see(path, known_length, **sections)
    assert isinstance(outcome, Done), outcome
    return outcome.value


@pytest.fixture(scope="module")
def found(view: tuple[Path, IdImage]) -> PerceivedObjects:
    """What is found in the view."""
    return find(view[0])


@pytest.mark.heavy
def test_the_boxes_are_found_on_the_table(view: tuple[Path, IdImage], found: PerceivedObjects) -> None:
    path, ids = view
    assert len(found.objects) == 2
    assert min(best_overlaps(ids, found.instance_ids)) > 0.8
    again = find(path)
    assert {o.object_id for o in found.objects} == {o.object_id for o in again.objects}
    np.testing.assert_array_equal(again.instance_ids, found.instance_ids)
    normal, true = (rotation_matrix(pose.quaternion_wxyz)[2] for pose in (found.camera_to_table, POSE))
    assert normal @ true > np.cos(np.radians(8.0))


@pytest.mark.heavy
def test_the_scale_is_estimated_and_says_how_sure_it_is(found: PerceivedObjects) -> None:
    seen = found.observation
    assert (seen.scale_source, seen.intrinsics_source) == ("estimated", "assumed")
    assert 0.05 < seen.scale_sigma < 1.0
    height = found.camera_to_table.position[2]
    assert abs(np.log(height / 0.6)) < 2 * seen.scale_sigma


@pytest.mark.heavy
def test_the_height_of_the_camera_measures_the_scale(view: tuple[Path, IdImage], found: PerceivedObjects) -> None:
    path, ids = view
    estimated, measured = found, find(path, HEIGHT, observe={"focal_px": CAMERA.fx})
    assert measured.observation.scale_source == "measured"
    assert 0 < measured.observation.scale_sigma < 0.1 < estimated.observation.scale_sigma
    assert measured.camera_to_table.position[2] == pytest.approx(0.6, rel=0.02)
    assert estimated.camera_to_table.position[2] != pytest.approx(0.6, rel=0.02)
    assert min(best_overlaps(ids, measured.instance_ids)) > 0.8
    distance = np.linalg.norm(measured.camera_to_table.position)
    assert distance == pytest.approx(np.linalg.norm(POSE.position), rel=0.25)


@pytest.mark.heavy
def test_the_net_reads_the_depth_of_a_sensor_too(view: tuple[Path, IdImage]) -> None:
    """`detector: picture` on a capture, whose metres stay the sensor's."""
    path, ids = view
    folder = path.parent / "capture"
    folder.mkdir()
    seen, _ = look(THINGS, POSE, floor_z=-0.7, wall_y=1.5)
    Image.open(path).save(folder / "color.png")
    Image.fromarray(np.rint(seen.depth * 1000).astype(np.uint16)).save(folder / "depth.png")
    camera = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    (folder / "camera.json").write_text(json.dumps(camera | {"depth_scale": 0.001}))
    row = ImageRow(scene_id="x", kind=SceneKind.CAPTURE, uri=str(folder))
    config = Config.model_validate({"perceive": {"detector": "picture"}})
    sensed = observe(row, config, np.random.default_rng(0), Services(Path()))
    assert isinstance(sensed, Done), sensed
    outcome = perceive(sensed.value, config, np.random.default_rng(0), Services(Path()))
    assert isinstance(outcome, Done), outcome
    assert outcome.value.observation.scale_source == "sensor"
    assert outcome.value.camera_to_table.position[2] == pytest.approx(0.6, rel=0.01)
    assert min(best_overlaps(ids, outcome.value.instance_ids)) > 0.7
    alone = find_table(sensed.value, np.random.default_rng(0), None)
    assert not isinstance(alone, Dropped)
    shown = detect_in_picture(alone, config, Services(Path())).shown
    assert shown is not None
    assert not (shown & ~alone.raised).any(), "only what the sensor sees stand has to be explained"
    assert (shown & (ids > 1)).sum() > 0.9 * (alone.raised & (ids > 1)).sum()


def test_the_table_of_boxes_reaches_beyond_the_objects() -> None:
    """A detector's table is fitted to the whole table-top, not to what lies about the objects."""
    seen, ids = look(THINGS, POSE, floor_z=-0.7, wall_y=1.5)
    view = find_table(seen, np.random.default_rng(0))
    assert not isinstance(view, Dropped)
    rows, columns = np.nonzero(ids == 2)
    box = (float(columns.min()), float(rows.min()), float(columns.max()), float(rows.max()))
    found = segment_boxes_in_picture(view, DetectionResult((Candidate("box", 1.0, box),)), Config()) == TABLE_ID
    assert found[ids == 1].mean() > 0.8
    assert found[ids > 1].mean() < 0.1


@pytest.mark.heavy
def test_what_a_sensor_reads_nothing_on_is_looked_at_too() -> None:
    """As on glass; the near box alone rises, in a part of the picture that the far one is no part of."""
    seen, ids = look(THINGS, POSE, floor_z=-0.7, wall_y=1.5)
    far = ids == ids[ids > 1].min()
    holed = replace(seen, depth=np.where(far, np.float32(0.0), seen.depth))
    view = find_table(holed, np.random.default_rng(0))
    assert not isinstance(view, Dropped)
    assert not (view.raised & far).any()
    found = predict_view(view, "")
    objects = upsample_ids((found.label[OBJECT] > 0.5).astype(np.int32), far.shape) > 0
    assert (objects & far).sum() > 0.8 * far.sum()


@pytest.mark.parametrize(("other", "stands"), [(0.05, True), (0.8, True), (0.95, False)])
def test_what_the_net_surely_takes_for_no_object_needs_no_explanation(other: float, stands: bool) -> None:
    """An arm over the table: the sensor sees it stand there, and no object explains it."""
    view = find_table(look(THINGS, POSE, floor_z=-0.7, wall_y=1.5)[0], np.random.default_rng(0))
    assert not isinstance(view, Dropped)
    size = view.valid.shape
    label = np.stack([np.full(size, p, np.float32) for p in (other, (1.0 - other) / 2, (1.0 - other) / 2)])
    zero = np.zeros(size, np.float32)
    votes, affinity = np.zeros((2, *size), np.float32), np.zeros((6, *size), np.float32)
    said = PicturePrediction(CAMERA, zero, label, votes, zero, affinity, np.array([0.0, 0.0, 1.0]), 1.0, 1.0, 0.1)
    assert bool(find_standing(view, said).any()) is stands


@pytest.mark.heavy
def test_weights_that_are_missing_stop_the_build_and_drop_no_picture(view: tuple[Path, IdImage]) -> None:
    for section in ({"observe": {"depth_weights": "missing.onnx"}}, {"perceive": {"detector_weights": "missing.onnx"}}):
        with pytest.raises(ModelAccessError, match=r"'missing\.onnx' is no file"):
            see(view[0], **section)


@pytest.mark.slow  # how good the net is, on several captures
@pytest.mark.heavy
def test_the_colour_of_synthetic_captures_shows_most_of_their_objects(tmp_path: Path) -> None:
    overlaps: list[float] = []
    for folder in synthesize_captures(tmp_path / "captures", 2, 0):
        found = find(folder / "color.png")
        true = np.asarray(Image.open(folder / "masks.png")).astype(np.int32)
        overlaps += best_overlaps(np.where(true > 0, true + 1, 0), found.instance_ids)
        assert found.observation.scale_source == "estimated"
        assert found.observation.scale_sigma > 0
    assert np.mean(np.array(overlaps) > 0.5) >= 0.5


@pytest.mark.heavy
def test_the_boxes_of_a_detector_get_masks(tmp_path: Path) -> None:
    (folder,) = synthesize_captures(tmp_path / "captures", 1, 0)
    true = np.asarray(Image.open(folder / "masks.png")).astype(np.int32)
    (folder / "masks.png").unlink()
    row = ImageRow(scene_id="x", kind=SceneKind.CAPTURE, uri=str(folder))
    perceived = {"detector": "replay", "segmenter": "picture", "min_explained": 0.0, "detector_weights": "another/net"}
    config = Config.model_validate({"perceive": perceived})
    seen = observe(row, config, np.random.default_rng(0), Services(Path()))
    assert isinstance(seen, Done), seen
    outcome = perceive(seen.value, config, np.random.default_rng(0), Services(Path()))
    assert isinstance(outcome, Done), outcome
    overlaps = best_overlaps(np.where(true > 0, true + 1, 0), outcome.value.instance_ids)
    assert np.mean(np.array(overlaps) > 0.5) > 0.5
    assert len({o.label for o in outcome.value.objects}) > 1
    assert record_segmenter(config, {}) is None, "its weights are part of the code"
    named = Config.model_validate({"perceive": {**perceived, "segmenter_weights": str(tmp_path / "own.onnx")}})
    with pytest.raises(ConfigError, match=r"perceive\.segmenter_weights: .*own\.onnx' is not there"):
        record_segmenter(named, {})
    with pytest.raises(ModelAccessError, match=r"own\.onnx' is no file"):
        perceive(seen.value, named, np.random.default_rng(0), Services(Path()))


@pytest.mark.parametrize(("bend", "count"), [(0.02, 2), (0.0, 1)])
def test_what_the_net_took_for_the_room_is_found_and_has_to_be_explained_in_a_bare_picture_alone(bend, count) -> None:
    """A sensor's depth tells of itself what stands on the table."""
    seen, ids = look(THINGS, POSE)
    view = find_table(seen, np.random.default_rng(0))
    assert not isinstance(view, Dropped), view
    view = replace(view, observation=replace(view.observation, bend=bend))
    label = np.zeros((3, *ids.shape), np.float32)
    label[TABLE][ids < 2] = 1.0
    label[OBJECT][ids == 2] = 1.0
    label[:, ids == 3] = np.array([[0.8], [0.0], [0.2]])
    votes, at = np.zeros((2, *ids.shape), np.float32), np.argwhere(ids == 2)
    votes[::-1, ids == 2] = (at.mean(axis=0) - at).T
    up = rotation_matrix(POSE.quaternion_wxyz)[2]
    depth = np.where(seen.depth > 0.0, seen.depth, 10.0).astype(np.float32)
    certain = np.full((6, *ids.shape), 5.0, np.float32), up, float(POSE.position[2]), 0.9, 0.1
    found = PicturePrediction(CAMERA, depth, label, votes, np.zeros(ids.shape, np.float32), *certain)
    answer = detect_predicted(view, found)
    assert len(answer.candidates) == count
    if bend:
        assert answer.shown[ids == 3].mean() > 0.9
