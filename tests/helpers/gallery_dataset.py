"""Datasets made by hand, with text in them that somebody meant badly."""

import io
import json
import tarfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import trimesh
from PIL import Image

from schemas.geometry import Camera, Pose, TriangleMesh
from schemas.tables import TABLES
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.mjcf.spec import SceneBody, make_scene_body, make_scene_files
from tableverse_factory.physics.render.render import look_at
from tableverse_factory.stages.export.texture import bake_texture

HOSTILE = (
    "</script><script>alert(1)</script>\"'/><img src=x onerror=alert(2)> {{ 7 * 7 }} &amp; \u2028javascript:alert(3)"
)
CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
EYE = look_at(np.array([0.0, -0.6, 0.45]), np.array([0.0, 0.0, 0.0]))
MEASURED = {"scale_source": "measured", "scale_sigma": 0.0132, "intrinsics_source": "exif", "field_of_view_deg": 56.1}
RED, GREEN = (210, 30, 30), (30, 160, 40)


def painted_box(size: tuple[float, float, float], color: tuple[int, int, int]) -> TriangleMesh:
    mesh = from_trimesh(trimesh.creation.box(size))
    return TriangleMesh(mesh.vertices, mesh.faces, np.tile(np.array(color, dtype=np.uint8), (len(mesh.vertices), 1)))


def body(object_id: str, mesh: TriangleMesh, x: float, y: float) -> SceneBody:
    pose = Pose(np.array([x, y, -mesh.vertices[:, 2].min()]), np.array([1.0, 0.0, 0.0, 0.0]))
    return replace(make_scene_body(object_id, mesh, (mesh,), 1.0, 0.1, pose), appearance=bake_texture(mesh))


def scene_members(scene_id: str, photographed: bool) -> dict[str, bytes]:
    """A red box at the origin and a green one to its right, as export writes them."""
    bodies = [
        body("obj_000", painted_box((0.08, 0.08, 0.08), RED), 0.0, 0.0),
        body("obj_001", painted_box((0.05, 0.05, 0.12), GREEN), 0.15, 0.05),
    ]
    slab = Slab(np.zeros(2), np.array([0.4, 0.3]), 0.0, (190, 170, 150))
    files = make_scene_files(bodies, slab, model_name=scene_id, view=PosedCamera(CAMERA, EYE) if photographed else None)
    meta: dict[str, Any] = {
        "format": "tableverse-scene-1",
        "camera": None,
        "camera_to_table": None,
        "left_out": [["obj_007", HOSTILE]],
        "assessment": {"reason_codes": ["NON_TABLETOP_OBJECT"], "criterion_scores": {HOSTILE: 3}},
    }
    members = {"scene.xml": files.xml.encode(), **files.assets}
    if photographed:
        picture = io.BytesIO()
        Image.new("RGB", (CAMERA.width, CAMERA.height), (120, 130, 140)).save(picture, "JPEG")
        members["observation/color.jpg"] = picture.getvalue()
        keys = ("fx", "fy", "cx", "cy", "width", "height")
        meta["camera"] = {key: getattr(CAMERA, key) for key in keys}
        quaternion = EYE.quaternion_wxyz.tolist()
        meta["camera_to_table"] = {"position": EYE.position.tolist(), "quaternion_wxyz": quaternion}
    return {**members, "meta.json": json.dumps(meta).encode()}


def write_dataset(out: Path, done: dict[str, dict[str, bytes]], lost: list[dict[str, Any]]) -> Path:
    """One shard with these scenes; every text column that may hold foreign text holds `HOSTILE`."""
    tar = io.BytesIO()
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
    with tarfile.open(fileobj=tar, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for scene_id, members in done.items():
            start = archive.offset
            for name, data in sorted(members.items()):
                info = tarfile.TarInfo(f"{scene_id}/{name}")
                info.size = len(data)
                archive.addfile(info, io.BytesIO(data))
            rows["scenes"].append(_done_row(scene_id, start, archive.offset - start))
            rows["objects"] += [_object_row(scene_id, f"obj_{k:03d}") for k in range(2)]
            rows["tasks"] += [_task_row(scene_id, k, accepted=k > 0) for k in range(3)]
    rows["scenes"] += [{"kind": "capture", "shard": 0, **row} for row in lost]
    for folder in ("mjcf", *TABLES):
        (out / folder).mkdir(parents=True)
    (out / "mjcf" / "shard-00000.tar").write_bytes(tar.getvalue())
    for name, schema in TABLES.items():
        full = [{field.name: row.get(field.name) for field in schema} for row in rows[name]]
        pq.write_table(pa.Table.from_pylist(full, schema=schema), out / name / "shard-00000.parquet")
    (out / "run.json").write_text("{}")
    return out


def _done_row(scene_id: str, offset: int, size: int) -> dict[str, Any]:
    figures = dict.fromkeys(
        ("piece_penetration_before_m", "mesh_penetration_before_m", "piece_penetration_m", "mesh_penetration_m"), 1e-5
    )
    return {
        "scene_id": scene_id,
        "kind": "capture",
        "name": f"{scene_id} {HOSTILE}",
        "source": HOSTILE,
        "licence": HOSTILE,
        "status": "done",
        "stage": "export",
        "attempts": 1,
        **(MEASURED if scene_id == "photo" else {"scale_source": "given"}),
        "perception": "geometric",
        "judge": "rules",
        "n_objects": 2,
        "usable": False,
        "quality_score": 4,
        "epsilon_m": 0.001,
        "drift_m": 2e-5,
        "drift_rad": 1e-4,
        "displacement_median_m": 0.004,
        "displacement_max_m": 0.009,
        "n_fell": 0,
        "n_left_container": 0,
        "twin_remarks": ["toppled:obj_001", "toppled:obj_000"],
        "at_rest": True,
        "colliding": False,
        "shard": 0,
        "tar_offset": offset,
        "tar_size": size,
        **figures,
    }


def _object_row(scene_id: str, object_id: str) -> dict[str, Any]:
    return {
        "scene_id": scene_id,
        "object_id": object_id,
        "label": HOSTILE,
        "relabel_name": HOSTILE,
        "distinguishing_phrases": [HOSTILE],
        "label_confidence": 0.5,
        "mass_kg": 0.123,
        "has_hinge": False,
        "graspable": True,
        "size_x_m": 0.08,
        "size_y_m": 0.08,
        "size_z_m": 0.08,
        "completion": HOSTILE,
        "n_pieces": 1,
    }


def _task_row(scene_id: str, number: int, accepted: bool) -> dict[str, Any]:
    return {
        "scene_id": scene_id,
        "task_id": f"task_{number:03d}",
        "instruction": f"Pick up {HOSTILE}",
        "x_id": "obj_000",
        "y_id": "obj_001",
        "relation": "on",
        "source": "rules",
        "accepted": accepted,
        "refusal": "" if accepted else HOSTILE,
    }
