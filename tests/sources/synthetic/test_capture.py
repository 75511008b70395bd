"""A capture folder read back: what is written agrees with itself and with the truth beside it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from schemas.config import ObserveConfig
from schemas.geometry import Camera, Pose, TriangleMesh
from tableverse_factory.geometry.collision.penetration import measure_mesh_penetrations
from tableverse_factory.geometry.math.transforms import invert_pose, transform_points
from tableverse_factory.geometry.mesh.meshes import place_mesh, read_mesh
from tableverse_factory.physics.mjcf.inertia import is_closed
from tableverse_factory.physics.render.raycast import Raycaster
from tableverse_factory.sources.capture import Capture, read_capture
from tableverse_factory.sources.synthetic.sensor import DepthSensor

pytestmark = pytest.mark.heavy


@pytest.fixture(params=[0, 1])
def folder(request: pytest.FixtureRequest, synthetic_folders: list[Path]) -> Path:
    return synthetic_folders[request.param]


@pytest.fixture
def truth(folder: Path) -> dict[str, Any]:
    value: dict[str, Any] = json.loads((folder / "truth.json").read_text())
    return value


@pytest.fixture
def capture(folder: Path) -> Capture:
    return read_capture(str(folder), ObserveConfig())


def pose_of(value: dict[str, list[float]]) -> Pose:
    return Pose(np.array(value["position"]), np.array(value["quaternion_wxyz"]))


def meshes_of(folder: Path, truth: dict[str, Any]) -> list[TriangleMesh]:
    return [read_mesh((folder / item["mesh"]).read_bytes(), item["mesh"]) for item in truth["objects"]]


def cast_truth(folder: Path, truth: dict[str, Any], camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Depth [m] and instance ids of the true objects alone, 0 where there is none."""
    placed = [
        place_mesh(m, pose_of(o["pose"])) for m, o in zip(meshes_of(folder, truth), truth["objects"], strict=True)
    ]
    hits = Raycaster(placed).cast(camera, pose_of(truth["camera_to_table"]))
    depth, ids = np.zeros(camera.height * camera.width), np.zeros(camera.height * camera.width, dtype=int)
    depth[hits.pixels], ids[hits.pixels] = hits.depth, hits.part + 1
    return depth.reshape(camera.height, -1), ids.reshape(camera.height, -1)


def test_the_objects_stand_on_the_table_and_in_nothing_else(folder: Path, truth: dict[str, Any]) -> None:
    meshes, poses = meshes_of(folder, truth), [pose_of(item["pose"]) for item in truth["objects"]]
    assert len(meshes) >= 3
    for mesh, pose, item in zip(meshes, poses, truth["objects"], strict=True):
        assert is_closed(mesh)
        assert_allclose(np.ptp(mesh.vertices, axis=0), item["size_m"], atol=1e-6)
        lowest = transform_points(pose, mesh.vertices)[:, 2].min()
        assert lowest > -0.001, item["label"]
    assert any(transform_points(p, m.vertices)[:, 2].min() < 0.001 for m, p in zip(meshes, poses, strict=True))
    deep = [pair for pair in measure_mesh_penetrations(meshes, poses, [1.0] * len(meshes)) if pair[2] > 0.002]
    assert not deep


def test_masks_agree_with_detections_and_with_the_truth(folder: Path, truth: dict[str, Any], capture: Capture) -> None:
    assert capture.ids is not None
    assert capture.detections is not None
    found = capture.detections
    boxes = {d.instance_id: d.bbox_xyxy for d in found.detections if d.instance_id is not None}
    for composite in found.composites:
        boxes |= {part.instance_id: part.bbox for part in (composite.container, *composite.contents)}
    labels = {item["instance_id"]: item["label"] for item in truth["objects"]}
    assert set(boxes) == set(np.unique(capture.ids)) - {0}
    assert set(boxes) <= set(labels)
    height, width = capture.ids.shape
    for instance, box in boxes.items():
        rows, columns = np.nonzero(capture.ids == instance)
        corners = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
        assert_allclose(np.array(box) * [width, height, width, height] / 1000, corners, atol=0.01)
        assert len(rows) >= 60
    _, ids = cast_truth(folder, truth, capture.camera)
    detected = capture.ids > 0
    assert (ids[detected] == capture.ids[detected]).mean() > 0.999
    assert [d.label for d in found.detections].count("table") == 1


def test_every_object_is_detected_once_unless_it_is_hidden(truth: dict[str, Any], capture: Capture) -> None:
    assert capture.detections is not None
    found = capture.detections
    named = [d.instance_id for d in found.detections if d.label != "table"]
    named += [part.instance_id for c in found.composites for part in (c.container, *c.contents)]
    seen = [o["instance_id"] for o in truth["objects"] if o["visible_pixels"] >= 60 and o["visible_fraction"] >= 0.01]
    assert sorted(named) == seen
    inside = {o["instance_id"]: o["contained_in"] for o in truth["objects"]}
    for composite in found.composites:
        assert composite.contents
        assert all(inside[part.instance_id] == composite.container.instance_id for part in composite.contents)
    assert all(0.0 <= o["visible_fraction"] <= 1.0 for o in truth["objects"])
    assert max(o["visible_fraction"] for o in truth["objects"]) > 0.9


def test_depth_is_the_truth_up_to_the_sensor(folder: Path, truth: dict[str, Any], capture: Capture) -> None:
    assert capture.ids is not None
    depth, _ = cast_truth(folder, truth, capture.camera)
    read = (capture.ids > 0) & (capture.depth > 0)
    assert read.sum() > 0.8 * (capture.ids > 0).sum()
    error = (capture.depth - depth)[read]
    worst = DepthSensor(baseline_m=0.065, disparity_sigma=0.065)  # the noisiest specimen that is made
    sigma = np.array([worst.sigma_m(z, capture.camera.fx) for z in depth[read]])
    assert np.median(np.abs(error)) < 1.5 * np.median(sigma)
    assert np.median(error / sigma) == pytest.approx(0.0, abs=0.3)
    assert (np.abs(error) < 5 * sigma + 0.004).mean() > 0.97  # the rest are readings from beside a depth edge


def test_the_table_is_the_plane_that_the_truth_names(truth: dict[str, Any], capture: Capture) -> None:
    camera, pose = capture.camera, pose_of(truth["camera_to_table"])
    assert capture.ids is not None
    v, u = np.nonzero((capture.ids == 0) & (capture.depth > 0))
    z = capture.depth[v, u].astype(np.float64)
    points = transform_points(
        pose, np.column_stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
    )
    half = np.array(truth["table"]["half_size_xy"]) - 0.05
    on_table = (np.abs(points[:, :2]) < half).all(axis=1)
    assert on_table.mean() > 0.2
    assert abs(np.median(points[on_table, 2])) < 0.003
    eye = pose.position
    assert eye[2] > 0.2
    ray = transform_points(invert_pose(pose), np.zeros((1, 3)))[0]
    assert ray[2] > 0.3  # the table lies in front of the camera


def test_the_picture_is_neither_black_nor_blown_out(capture: Capture, folder: Path) -> None:
    assert 40 < capture.color.mean() < 225
    assert capture.color.std() > 12
    assert (capture.color.min(axis=2) > 250).mean() < 0.2
    assert Image.open(folder / "depth.png").mode == "I;16"
    assert json.loads((folder / "source.json").read_text()) == {"source": "synthetic", "licence": "CC0-1.0"}
