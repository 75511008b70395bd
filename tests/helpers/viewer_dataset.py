"""Datasets to look at: two boxes, a camera, a photograph, three layouts, motions, and names that were meant badly."""

import io
import json
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from schemas.scene import Certificate, ExportedScene
from schemas.tables import OBJECTS, SCENES, TASKS, TRAJECTORIES
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.dataset import Scene, open_dataset
from tableverse_factory.dataset.shards import TarShard, shard_path
from tableverse_factory.dataset.trajectory_files import add_digests
from tests.helpers.recorded_dataset import (
    CAMERA,
    X_ID,
    Y_ID,
    encode_recording,
    recording,
    scene_members,
    trajectory_row,
)

HOSTILE = "</div><script>alert(1)</script>\"'><img src=x onerror=alert(2)> **b** &amp;"
ASIDE_M, ABOVE_M = 0.1, 0.05
"""Where the picture had the green block, besides where it settled: aside; where it was before it fell: above."""

LABELS = {Y_ID: "red block", X_ID: HOSTILE}


def members(scene_id: str, photographed: bool = True) -> dict[str, bytes]:
    files = scene_members(scene_id, photographed)
    meta = json.loads(files["meta.json"])
    meta["certificate"] = {"drift_m": 2e-5, "drift_rad": 1e-4, "piece_penetration_m": 1e-5}
    for item, place in zip(meta["objects"], ((0.0, 0.0, 0.03), (0.18, 0.05, 0.06)), strict=True):
        item["poses"] = {
            "placed": _pose(place[0] + ASIDE_M * (item["object_id"] == X_ID), *place[1:]),
            "rectified": _pose(*place[:2], place[2] + ABOVE_M),
            "settled": _pose(*place),
        }
    files["meta.json"] = json.dumps(meta).encode()
    if photographed:
        picture = io.BytesIO()
        Image.new("RGB", (CAMERA.width, CAMERA.height), (120, 130, 140)).save(picture, "JPEG")
        files["observation/color.jpg"] = picture.getvalue()
    return files


def scene_of(photographed: bool = True) -> Scene:
    return Scene("a-1", {}, members("a-1", photographed))


def write_viewed_dataset(out: Path, more: Sequence[str] = ()) -> Path:
    """A scene with a success and a failure, one without a camera, one that was dropped; more like the second."""
    lost = {"scene_id": "c-3", "status": "dropped", "stage": "settle", "reason": "not_at_rest", "detail": HOSTILE}
    moved = [
        (trajectory_row("a-1", "task_000", True), encode_recording(recording())),
        (trajectory_row("a-1", "task_001", False), encode_recording(recording(31, swing=-0.5))),
        (trajectory_row("a-1", "task_002", False, arrays=None, reason="no_grasp", failed_phase=None), None),
    ]
    scenes, files = [{**lost, "shard": 0}], {"a-1": members("a-1"), "b-2": members("b-2", photographed=False)}
    files.update({scene_id: members(scene_id, photographed=False) for scene_id in more})
    files["a-1"].update({row["arrays"]: data for row, data in moved if data is not None})
    path = shard_path(out, "mjcf", 0)
    path.parent.mkdir(parents=True)
    with path.open("wb") as file:
        tar = TarShard(file)
        for scene_id, content in files.items():
            certificate = Certificate(0.001, *[0.0] * 6, (), (), (), True, False)
            exported = ExportedScene(scene_id, tuple(sorted(content.items())), certificate, {}, (), ())
            offset, size = tar.add(exported)
            scenes.append(_scene_row(scene_id, offset, size))
        tar.close()
    objects = [
        {"scene_id": scene_id, "object_id": name, "label": label, "relabel_name": label, "mass_kg": 0.1}
        for scene_id in files
        for name, label in LABELS.items()
    ]
    tasks = [{"scene_id": "a-1", "task_id": "task_000", "instruction": HOSTILE, "accepted": True}]
    rows = add_digests([row for row, _ in moved], tuple(files["a-1"].items()))
    tables = (
        ("scenes", SCENES, sorted(scenes, key=lambda row: row["scene_id"])),
        ("objects", OBJECTS, objects),
        ("tasks", TASKS, tasks),
        ("trajectories", TRAJECTORIES, rows),
    )
    for folder, schema, table in tables:
        write_atomic(shard_path(out, folder, 0), encode_parquet(build_table(table, schema)))
    (out / "run.json").write_text("{}")
    return out


def many_scenes(out: Path, count: int) -> Path:
    """A dataset of so many scenes that were lost, each with two objects' labels: a long list, and no files."""
    ids = [f"s-{number:06d}" for number in range(count)]
    scenes = [{"scene_id": name, "name": f"table {name}", "status": "dropped", "shard": 0} for name in ids]
    objects = [{"scene_id": name, "object_id": "obj_000", "label": f"mug k{name[-2:]}"} for name in ids]
    for folder, schema, table in (("scenes", SCENES, scenes), ("objects", OBJECTS, objects), ("tasks", TASKS, [])):
        write_atomic(shard_path(out, folder, 0), encode_parquet(build_table(table, schema)))
    (out / "run.json").write_text("{}")
    return out


def opened(out: Path, more: Sequence[str] = ()):
    return open_dataset(write_viewed_dataset(out, more))


def _pose(x: float, y: float, z: float) -> dict[str, list[float]]:
    return {"position": [x, y, z], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}


def _scene_row(scene_id: str, offset: int, size: int) -> dict[str, object]:
    return {
        "scene_id": scene_id,
        "kind": "capture",
        "name": HOSTILE,
        "source": HOSTILE,
        "licence": "CC0-1.0",
        "status": "done",
        "stage": "export",
        "n_objects": 2,
        "quality_score": 8,
        "shard": 0,
        "tar_offset": offset,
        "tar_size": size,
    }
