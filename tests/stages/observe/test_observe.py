"""The first stage: what it reads comes through exactly, and what is hostile is dropped with its reason."""

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done, Dropped
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.models.services import Services
from tableverse_factory.sources.manifest import make_manifest
from tableverse_factory.stages.observe.observe import DEPTH_MODELS, observe, read_layout
from tests.helpers.captures_on_disk import CAMERA, MESH, huge_png, write_capture, write_layout, write_picture

ANYTHING = np.random.default_rng(0)
SERVICES = Services(Path("unused"))


def observed(folder, kind=SceneKind.CAPTURE, **config):
    row = ImageRow(scene_id="a", kind=kind, uri=str(folder))
    return observe(row, Config.model_validate({"observe": config}), ANYTHING, SERVICES)


def laid_out(path):
    return read_layout(ImageRow(scene_id="a", kind=SceneKind.LAYOUT, uri=str(path)), Config(), ANYTHING, SERVICES)


def refusal(outcome):
    assert isinstance(outcome, Dropped), outcome
    assert outcome.detail
    return outcome.reason


def test_colour_depth_and_camera_come_through_exactly(tmp_path):
    depth = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32) + 400
    folder = write_capture(tmp_path / "c", 3, depth)
    found = observed(folder).value
    np.testing.assert_array_equal(found.color, np.array(Image.open(folder / "color.png")))
    np.testing.assert_allclose(found.depth, depth * 0.001, rtol=1e-6)
    assert found.depth.dtype == np.float32
    assert (found.camera.fx, found.camera.cx, found.camera.width) == (30.0, 16.0, 32)
    assert found.recorded_detections is None
    assert found.recorded_ids is None
    assert found.scene_id == "a"


def test_colour_may_be_a_jpeg_or_have_a_palette_or_alpha(tmp_path):
    folder = write_capture(tmp_path / "c", 1)
    picture = Image.open(folder / "color.png").copy()
    for mode in ("RGBA", "P", "L"):
        picture.convert(mode).save(folder / "color.png")
        assert observed(folder).value.color.shape == (24, 32, 3)
    (folder / "color.png").unlink()
    picture.save(folder / "color.jpg")
    assert observed(folder).value.color.shape == (24, 32, 3)


def test_depth_beyond_the_bound_counts_as_no_reading(tmp_path):
    depth = np.full((24, 32), 800, np.uint16)
    depth[:, :10] = 6000
    found = observed(write_capture(tmp_path / "c", 1, depth)).value
    assert (found.depth[:, :10] == 0).all()
    assert (found.depth[:, 10:] > 0).all()
    assert refusal(observed(tmp_path / "c", max_depth_m=0.5)) == "depth_all_zero"


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_recorded_masks_and_detections_come_through(tmp_path, kind):
    folder = write_capture(tmp_path / "c", 1)
    ids = np.zeros((24, 32), kind)
    ids[5:10, 5:10] = 200
    Image.fromarray(ids).save(folder / "masks.png")
    detections = {"detections": [{"label": "a\nmug", "bbox_xyxy": [0, 0, 500, 1000], "instance_id": 200}]}
    (folder / "detections.json").write_text(json.dumps(detections))
    found = observed(folder).value
    np.testing.assert_array_equal(found.recorded_ids, ids)
    assert found.recorded_detections.detections[0].label == "a mug"


@pytest.mark.parametrize(
    "wrong",
    [
        {"fx": float("nan")},
        {"fy": float("inf")},
        {"fx": -30.0},
        {"fx": 0.0},
        {"fy": "30"},
        {"fx": True},
        {"fx": 10**400},
        {"cx": 400.0},
        {"cy": -5.0},
        {"width": 64},
        {"height": None},
        {"depth_scale": 0.0},
        {"depth_scale": float("nan")},
        {"depth_scale": -0.001},
    ],
    ids=str,
)
def test_intrinsics_that_cannot_be_are_dropped(tmp_path, wrong):
    assert refusal(observed(write_capture(tmp_path / "c", 1, **wrong))) == "bad_intrinsics"


@pytest.mark.parametrize("name", list(CAMERA))
def test_a_camera_file_without_one_of_its_numbers_is_dropped(tmp_path, name):
    folder = write_capture(tmp_path / "c", 1)
    (folder / "camera.json").write_text(json.dumps({k: v for k, v in CAMERA.items() if k != name}))
    outcome = observed(folder)
    assert refusal(outcome) == "bad_intrinsics"
    assert name in outcome.detail


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "nonsense",
        "[" * 100_000,
        '{"a":' * 5000 + "1" + "}" * 5000,
        " " * 2_000_000,
        "\ud800".encode("utf-8", "surrogatepass"),
    ],
    ids=["empty", "list", "no json", "deep list", "deep object", "long", "broken text"],
)
def test_a_camera_file_that_is_no_camera_is_dropped(tmp_path, text):
    folder = write_capture(tmp_path / "c", 1)
    (folder / "camera.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    assert refusal(observed(folder)) in ("bad_intrinsics", "file_too_large")


@pytest.mark.parametrize("name", ["color.png", "depth.png", "masks.png"])
def test_a_huge_picture_is_refused_before_a_pixel_is_decoded(tmp_path, name):
    folder = write_capture(tmp_path / "c", 1)
    (folder / name).write_bytes(huge_png(60_000, 60_000))
    tracemalloc.start()
    outcome = observed(folder)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert refusal(outcome) == "picture_too_large"
    assert "60000" in outcome.detail or "3600000000" in outcome.detail
    assert peak < 10_000_000


def test_the_bound_on_pixels_is_the_configured_one(tmp_path):
    folder = write_capture(tmp_path / "c", 1)
    assert isinstance(observed(folder, max_pixels=24 * 32), Done)
    assert refusal(observed(folder, max_pixels=24 * 32 - 1)) == "picture_too_large"


@pytest.mark.parametrize("name", ["color.png", "depth.png", "masks.png"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.5])
def test_truncated_pictures_are_dropped(tmp_path, name, share):
    folder = write_capture(tmp_path / "c", 1, np.random.default_rng(0).integers(500, 900, (24, 32)).astype(np.uint16))
    Image.fromarray(np.ones((24, 32), np.uint16)).save(folder / "masks.png")
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(whole[: int(share * len(whole))])
    expected = {"color.png": "unreadable_color", "depth.png": "unreadable_depth", "masks.png": "bad_masks"}
    assert refusal(observed(folder)) == expected[name]


@pytest.mark.parametrize(
    ("depth", "reason"),
    [
        (np.full((24, 32), 80, np.uint8), "depth_not_16_bit"),
        (np.full((24, 32, 3), 80, np.uint8), "depth_not_16_bit"),
        (np.full((48, 64), 800, np.uint16), "depth_size_differs"),
        (np.zeros((24, 32), np.uint16), "depth_all_zero"),
    ],
    ids=["8 bit", "colour", "other size", "all zero"],
)
def test_depth_that_cannot_be_used_is_dropped(tmp_path, depth, reason):
    assert refusal(observed(write_capture(tmp_path / "c", 1, depth))) == reason


@pytest.mark.parametrize("masks", [np.ones((24, 32, 3), np.uint8), np.ones((10, 10), np.uint8)], ids=["rgb", "size"])
def test_masks_that_do_not_fit_are_dropped(tmp_path, masks):
    folder = write_capture(tmp_path / "c", 1)
    Image.fromarray(masks).save(folder / "masks.png")
    assert refusal(observed(folder)) == "bad_masks"


@pytest.mark.parametrize(
    "text",
    [
        "{",
        '{"detections": [{"label": "a", "bbox_xyxy": [0, 0, 2000, 10]}]}',
        '{"detections": [{"label": "a", "bbox_xyxy": [NaN, 0, 5, 5]}]}',
        '{"detections": [{"label": "a", "bbox_xyxy": [0, 0, 5]}]}',
        '{"composites": [{"container": {"label": "a"}}]}',
        json.dumps({"detections": [{"label": "a", "bbox_xyxy": [0, 0, 5, 5]}] * 300}),
        '"' + "x" * 17_000_000 + '"',
    ],
    ids=["no json", "beyond 1000", "nan", "three numbers", "no box", "too many", "17 MB"],
)
def test_detections_outside_the_schema_are_dropped(tmp_path, text):
    folder = write_capture(tmp_path / "c", 1)
    (folder / "detections.json").write_text(text)
    assert refusal(observed(folder)) in ("bad_detections", "file_too_large")


def test_a_file_over_the_bound_is_not_read(tmp_path):
    assert refusal(observed(write_capture(tmp_path / "c", 1), max_file_bytes=100)) == "file_too_large"


@pytest.mark.parametrize("uri", ["/nowhere/at/all", "nosuch://bucket/x", "http://[bad"])
def test_a_place_that_is_not_there_is_dropped(uri):
    assert refusal(observed(uri)) in ("missing_color", "unreachable_uri")


def test_a_picture_without_a_depth_model_says_which_there_are(tmp_path):
    outcome = observed(write_picture(tmp_path / "photo.jpg", 1), SceneKind.IMAGE, depth="sensor")
    assert refusal(outcome) == "no_depth_model"
    assert all(name in outcome.detail for name in DEPTH_MODELS)


@pytest.mark.parametrize("stage", [observe, read_layout])
def test_a_rejected_row_keeps_its_reason(stage):
    row = ImageRow(scene_id="a", kind="capture", uri="/x", rejected="unreadable_color", rejected_detail="why")
    assert stage(row, Config(), ANYTHING, SERVICES) == Dropped("unreadable_color", "why")


def test_a_layout_comes_through_with_its_poses_and_a_table_around_it(tmp_path):
    pose = {"position": [0.1, -0.2, 0.3], "quaternion_wxyz": [0.0, 0.0, 0.0, 2.0]}
    found = laid_out(write_layout(tmp_path / "l" / "a.json", scale=0.5, pose=pose)).value
    (item,) = found.objects
    assert (item.object_id, item.scale, item.completion, found.perception) == ("obj_000", 0.5, "layout", "layout")
    np.testing.assert_allclose(item.pose.position, [0.1, -0.2, 0.3])
    np.testing.assert_allclose(np.abs(item.pose.quaternion_wxyz), [0, 0, 0, 1], atol=1e-12)
    corner = place_mesh(item.mesh, item.pose, item.scale).vertices[1]
    np.testing.assert_allclose(corner, [0.1 - 0.05, -0.2, 0.3], atol=1e-9)
    vertices = place_mesh(item.mesh, item.pose, item.scale).vertices[:, :2]
    assert (np.abs(vertices - found.table.center_xy) < found.table.half_size_xy - 0.1).all()


def test_a_mesh_in_millimetres_makes_no_table_of_a_hundred_metres(tmp_path):
    path = write_layout(tmp_path / "a.json")
    layout = json.loads(path.read_text())
    layout["objects"].append({**layout["objects"][0], "id": "obj_001", "scale": 1000.0})
    path.write_text(json.dumps(layout))
    assert (laid_out(path).value.table.half_size_xy < 1.0).all()


@pytest.mark.parametrize("mesh", ["mug.obj", "./mug.obj", "../meshes/mug.obj", "deep/../mug.obj"])
def test_meshes_may_lie_beside_the_layout_or_beside_its_folder(tmp_path, mesh):
    path = write_layout(tmp_path / "l" / "a.json", mesh=mesh)
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "mug.obj").write_bytes(MESH)
    assert len(laid_out(path).value.objects) == 1


@pytest.mark.parametrize(
    "mesh", ["/etc/passwd", "../../mug.obj", "a/../../../mug.obj", "..\\mug.obj", "file:///mug.obj", "x::mug.obj", ".."]
)
def test_meshes_from_elsewhere_are_refused(tmp_path, mesh):
    (tmp_path / "mug.obj").write_bytes(MESH)
    assert refusal(laid_out(write_layout(tmp_path / "x" / "l" / "a.json", mesh=mesh))) == "bad_mesh_path"


def test_a_link_does_not_lead_out(tmp_path):
    secret = tmp_path / "secret.obj"
    secret.write_bytes(MESH)
    path = write_layout(tmp_path / "x" / "l" / "a.json", mesh="mug.obj", content=None)
    (path.parent / "mug.obj").symlink_to(secret)
    assert refusal(laid_out(path)) == "bad_mesh_path"


@pytest.mark.parametrize(
    "content", [b"", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", b"f 1 2 3\n"], ids=["empty", "nan", "no vertex"]
)
def test_a_mesh_without_sound_triangles_is_refused(tmp_path, content):
    assert refusal(laid_out(write_layout(tmp_path / "a.json", content=content))) == "bad_mesh"


@pytest.mark.parametrize(
    "changes",
    [
        {"id": "../../x"},
        {"scale": 0},
        {"scale": float("nan")},
        {"contained_in": "obj_999"},
        {"pose": {"position": [0, 0, float("inf")], "quaternion_wxyz": [1, 0, 0, 0]}},
        {"pose": {"position": [0, 0, 0], "quaternion_wxyz": [0, 0, 0, 0]}},
    ],
    ids=str,
)
def test_a_layout_outside_the_schema_is_refused(tmp_path, changes):
    assert refusal(laid_out(write_layout(tmp_path / "a.json", **changes))) == "bad_layout"


@pytest.mark.heavy
@pytest.mark.shared
def test_every_real_capture_and_layout_is_read(shared_dir):
    captures = sorted(p for p in (shared_dir / "captures").iterdir() if p.is_dir())
    assert captures
    for folder in captures[::5]:
        assert isinstance(observed(folder), Done), folder.name
    layouts = sorted((shared_dir / "layouts").glob("*.json"))
    for path in layouts[::20]:
        assert isinstance(laid_out(path), Done), path.name


@pytest.mark.parametrize("name", ["color.png", "depth.png", "camera.json"])
def test_a_capture_that_is_not_what_the_manifest_saw_is_dropped(tmp_path, name):
    folder = write_capture(tmp_path / "c", 1)
    (row,) = make_manifest([str(folder)], Config().observe).rows
    assert isinstance(observe(row, Config(), ANYTHING, SERVICES), Done)
    path = folder / name
    path.write_bytes(path.read_bytes() + b" ")
    assert refusal(observe(row, Config(), ANYTHING, SERVICES)) == "content_changed"


def test_a_picture_that_its_row_calls_a_capture_is_told_what_a_capture_is(tmp_path):
    write_capture(tmp_path / "c", 1)
    (row,) = make_manifest([str(tmp_path / "c" / "color.png")], Config().observe).rows
    outcome = observe(row.model_copy(update={"kind": SceneKind.CAPTURE}), Config(), ANYTHING, SERVICES)
    assert refusal(outcome) == "missing_color"
    assert "a capture is a folder" in outcome.detail


def test_a_layout_whose_mesh_was_swapped_is_dropped(tmp_path):
    path = write_layout(tmp_path / "a.json")
    (row,) = make_manifest([str(path)], Config().observe).rows
    assert isinstance(read_layout(row, Config(), ANYTHING, SERVICES), Done)
    mesh = tmp_path / "mug.obj"
    mesh.write_bytes(mesh.read_bytes() + b"# another\n")
    assert refusal(read_layout(row, Config(), ANYTHING, SERVICES)) == "content_changed"
