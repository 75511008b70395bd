"""A bare picture with depth recorded beside it runs through the line, and is what the capture would have been."""

import json

import numpy as np
import pytest
from PIL import Image

from schemas.codec import encode
from schemas.config import Config
from schemas.manifest import SceneKind
from schemas.outcome import Done, Dropped
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.geometry.math.transforms import rotation_angle
from tableverse_factory.models.services import Services
from tableverse_factory.sources.manifest import make_manifest
from tableverse_factory.stages.observe.observe import observe
from tableverse_factory.stages.perceive.perceive import perceive
from tests.helpers.tabletop_views import Box, look

THINGS = (Box(-0.12, 0.05, (0.1, 0.06, 0.15)), Box(0.15, -0.05, (0.08, 0.08, 0.08)))
RECORDED = Config.model_validate({"observe": {"depth": "recorded"}})


def as_capture(folder, observation):
    folder.mkdir(parents=True)
    Image.fromarray(observation.color).save(folder / "color.png")
    Image.fromarray(np.rint(observation.depth * 10_000).astype(np.uint16)).save(folder / "depth.png")
    (folder / "camera.json").write_text(json.dumps(intrinsics(observation.camera) | {"depth_scale": 0.0001}))
    return folder


def as_picture(folder, observation, depth=None, bend=0.0, **camera):
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(observation.color).save(folder / "table.png")
    exact = np.rint(observation.depth * 10_000).astype(np.uint16).astype(np.float32) * np.float32(0.0001)
    np.save(folder / "table.depth.npy", exact if depth is None else depth)
    said = intrinsics(observation.camera) | {"bend": bend} | camera
    (folder / "table.camera.json").write_text(json.dumps(said))
    return folder / "table.png"


def intrinsics(camera):
    return {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}


def rows_of(folder):
    return make_manifest([str(folder)], Config().observe).rows


def observed(folder, config=RECORDED):
    (row,) = rows_of(folder)
    return observe(row, config, np.random.default_rng(0), Services(folder))


def refusal(outcome):
    assert isinstance(outcome, Dropped), outcome
    assert outcome.detail
    return outcome.reason


@pytest.fixture(scope="module")
def view():
    return look(THINGS, noise_m=0.001)[0]


@pytest.mark.heavy
def test_the_picture_gives_what_the_capture_gives(tmp_path, view):
    as_capture(tmp_path / "captures" / "table", view)
    as_picture(tmp_path / "pictures", view)
    (picture,), (capture,) = rows_of(tmp_path / "pictures"), rows_of(tmp_path / "captures")
    assert picture.kind is SceneKind.IMAGE
    found = []
    for row in (picture, capture):
        seen = observe(
            row.model_copy(update={"scene_id": "same"}), RECORDED, np.random.default_rng(0), Services(tmp_path)
        )
        assert isinstance(seen, Done), seen
        found.append(perceive(seen.value, RECORDED, np.random.default_rng(0), Services(tmp_path)))
    assert len(found[0].value.objects) == 2
    assert encode(found[0]) == encode(found[1])


@pytest.mark.slow
def test_the_whole_line_makes_the_same_scene_of_both(tmp_path, view, run):
    as_capture(tmp_path / "captures" / "table", view)
    as_picture(tmp_path / "pictures", view)
    poses = []
    for name in ("captures", "pictures"):
        out = tmp_path / f"{name}_out"
        assert run("manifest", tmp_path / name, "--out", tmp_path / f"{name}.parquet")[0] == 0
        line = ("build", tmp_path / f"{name}.parquet", out, "--executor", "local", "--set", "observe.depth=recorded")
        assert run(*line)[0] == 0
        (scene,) = open_dataset(out).scenes.to_table(columns=["scene_id", "status"]).to_pylist()
        assert scene["status"] == "done"
        rows = open_dataset(out).objects.to_table().to_pylist()
        poses.append([{k: v for k, v in row.items() if k != "scene_id"} for row in rows])
    assert len(poses[0]) == 2
    assert poses[0] == poses[1]


def test_depth_of_another_resolution_is_brought_back_and_its_bend_allowed_for(tmp_path, view):
    small = np.array(Image.fromarray(view.depth.astype(np.float32)).resize((320, 240), Image.Resampling.NEAREST))
    as_picture(tmp_path, view, depth=small, bend=0.01)
    outcome = observed(tmp_path)
    assert outcome.value.depth.shape == (480, 640)
    assert outcome.value.camera == view.camera
    assert outcome.value.bend == 0.01
    known = (outcome.value.depth > 0) & (view.depth > 0)
    assert np.median(np.abs(outcome.value.depth - view.depth)[known]) < 0.002


def test_without_depth_beside_it_the_picture_says_what_is_missing(tmp_path, view):
    path = as_picture(tmp_path, view)
    path.with_suffix(".depth.npy").unlink()
    outcome = observed(tmp_path)
    assert refusal(outcome) == "no_recorded_depth"
    assert outcome.detail.endswith("beside the picture there is no table.depth.npy")


def test_depth_in_millimetres_is_asked_for_its_unit(tmp_path, view):
    as_picture(tmp_path, view, depth=np.float32(1000) * view.depth)
    outcome = observed(tmp_path)
    assert refusal(outcome) == "depth_all_zero"
    nearest = 1000 * view.depth[view.depth > 0].min()
    assert f"the nearest is {nearest:.3g} m; is it in millimetres?" in outcome.detail
    assert outcome.detail.startswith("table.depth.npy holds no depth between 0 and observe.max_depth_m = 5 m")


@pytest.mark.parametrize(
    ("depth", "reason"),
    [
        (np.ones((480, 640), np.uint16), "unreadable_depth"),
        (np.ones((480, 640, 1), np.float32), "unreadable_depth"),
        (np.ones((0, 640), np.float32), "unreadable_depth"),
        (np.array([["x"]], dtype=object), "unreadable_depth"),
        (np.ones((640, 480), np.float32), "depth_size_differs"),
        (np.full((480, 640), np.nan, np.float32), "depth_all_zero"),
        (np.full((480, 640), 50.0, np.float16), "depth_all_zero"),
    ],
    ids=["integers", "three axes", "empty", "pickled", "turned", "nan", "far"],
)
def test_depth_that_cannot_be_used_is_a_reason(tmp_path, view, depth, reason):
    as_picture(tmp_path, view, depth=depth)
    assert refusal(observed(tmp_path)) == reason


def test_an_array_that_claims_more_than_its_file_holds_is_refused(tmp_path, view):
    path = as_picture(tmp_path, view).with_suffix(".depth.npy")
    path.write_bytes(path.read_bytes().replace(b"(480, 640)", b"(9999999, 9999999)")[:4096])
    assert refusal(observed(tmp_path)) == "unreadable_depth"


@pytest.mark.parametrize(
    "wrong",
    [
        {"fx": -1.0},
        {"cx": 9999.0},
        {"fy": "525"},
        {"width": 0},
        {"bend": 5.0},
        {"fx": None},
        {"fx": 10.0, "fy": 10.0},
        {"fx": 1e5, "fy": 1e5},
    ],
    ids=str,
)
def test_a_recorded_camera_that_cannot_be_is_a_reason(tmp_path, view, wrong):
    as_picture(tmp_path, view, **wrong)
    outcome = observed(tmp_path)
    assert refusal(outcome) == "bad_intrinsics"
    assert outcome.detail.startswith("table.camera.json: ")


def test_a_camera_without_a_number_and_an_array_that_is_none_say_so(tmp_path, view):
    as_picture(tmp_path, view)
    file = tmp_path / "table.camera.json"
    said = json.loads(file.read_text())
    file.write_text(json.dumps({key: said[key] for key in said if key != "fx"}))
    assert "fx is missing; give a finite number" in observed(tmp_path).detail
    file.write_text(json.dumps(said | {"cy": "wide"}))
    assert 'cy is "wide"; give a finite number' in observed(tmp_path).detail
    file.write_text(json.dumps(said))
    (tmp_path / "table.depth.npy").write_bytes(b"no array")
    assert "table.depth.npy is no array of numbers as numpy.save writes it" in observed(tmp_path).detail


def test_what_lies_beside_the_picture_belongs_to_its_content(tmp_path, view):
    path = as_picture(tmp_path, view)
    (row,) = rows_of(tmp_path)
    np.save(path.with_suffix(".depth.npy"), view.depth * 1.1)
    assert refusal(observe(row, RECORDED, np.random.default_rng(0), Services(tmp_path))) == "content_changed"


@pytest.mark.heavy
def test_a_capture_has_its_own_depth_whatever_the_key_says(tmp_path, view):
    folder = as_capture(tmp_path / "table", view)
    plain = observed(folder, Config())
    for name in ("recorded", "depth_anything_3", "moge_2", "depth_anything_2"):
        other = observed(folder, Config.model_validate({"observe": {"depth": name}}))
        assert encode(other) == encode(plain)


@pytest.mark.slow  # a whole line; test_picture.py has bent depth
@pytest.mark.heavy
def test_a_model_that_bends_the_table_still_gives_its_things(tmp_path, view):
    v, u = np.indices(view.depth.shape) / 480.0
    bent = view.depth * 1.04 * (1 + 0.012 * np.sin(4 * u + 1) * np.cos(5 * v))
    as_picture(tmp_path, view, depth=bent.astype(np.float32), bend=0.015)
    seen = perceive(observed(tmp_path).value, RECORDED, np.random.default_rng(0), Services(tmp_path))
    as_picture(tmp_path, view)
    true = perceive(observed(tmp_path).value, RECORDED, np.random.default_rng(0), Services(tmp_path))
    assert len(seen.value.objects) == 2
    turned = rotation_angle(seen.value.camera_to_table.quaternion_wxyz, true.value.camera_to_table.quaternion_wxyz)
    assert np.degrees(turned) < 2.0
