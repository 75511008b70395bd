"""A dataset whose tasks have trajectories: recordings made by hand, without physics, with the factory's own writers."""

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import trimesh

from schemas.geometry import Camera, Pose, TriangleMesh
from schemas.scene import Certificate, ExportedScene
from schemas.tables import OBJECTS, SCENES, TASKS, TRAJECTORIES
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.shards import TarShard, shard_path
from tableverse_factory.dataset.trajectory_files import add_digests
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.geometry.math.transforms import (
    compose_poses,
    identity_pose,
    quaternion_about_z,
    quaternion_from_matrix,
)
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.mjcf.spec import make_scene_body, make_scene_files
from tableverse_factory.physics.render.render import look_at
from tableverse_factory.robotics.execution.arrays import Recording, encode_recording
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.stages.export.texture import bake_texture

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
EYE = look_at(np.array([0.0, -0.6, 0.45]), np.array([0.0, 0.0, 0.0]))
RED, GREEN = (210, 30, 30), (30, 160, 40)
BASE = Pose(np.array([-0.45, 0.1, 0.0]), quaternion_about_z(0.0))
STEP_S = 0.05
X_ID, Y_ID = "obj_001", "obj_000"


def painted_box(size, color) -> TriangleMesh:
    mesh = from_trimesh(trimesh.creation.box(size))
    return TriangleMesh(mesh.vertices, mesh.faces, np.tile(np.array(color, dtype=np.uint8), (len(mesh.vertices), 1)))


def scene_members(scene_id: str, photographed: bool = True) -> dict[str, bytes]:
    """A red box at the origin and a narrow green one to its right."""
    bodies = []
    for object_id, size, color, x, y in (
        ("obj_000", (0.1, 0.1, 0.06), RED, 0.0, 0.0),
        ("obj_001", (0.04, 0.04, 0.12), GREEN, 0.18, 0.05),
    ):
        mesh = painted_box(size, color)
        pose = Pose(np.array([x, y, size[2] / 2]), np.array([1.0, 0.0, 0.0, 0.0]))
        bodies.append(replace(make_scene_body(object_id, mesh, (mesh,), 1.0, 0.1, pose), appearance=bake_texture(mesh)))
    slab = Slab(np.zeros(2), np.array([0.7, 0.45]), 0.0, (190, 170, 150))
    files = make_scene_files(bodies, slab, model_name=scene_id, view=PosedCamera(CAMERA, EYE) if photographed else None)
    meta = {
        "format": "tableverse-scene-1",
        "scene_id": scene_id,
        "camera": None,
        "camera_to_table": None,
        "left_out": [],
        "assessment": {"reason_codes": [], "criterion_scores": {}},
        "objects": [{"object_id": "obj_000", "contained_in": None}, {"object_id": "obj_001", "contained_in": None}],
    }
    if photographed:
        meta["camera"] = {key: getattr(CAMERA, key) for key in ("fx", "fy", "cx", "cy", "width", "height")}
        pose = {"position": EYE.position.tolist(), "quaternion_wxyz": EYE.quaternion_wxyz.tolist()}
        meta["camera_to_table"] = pose
    return {"scene.xml": files.xml.encode(), **files.assets, "meta.json": json.dumps(meta).encode()}


def recording(samples: int = 41, swing: float = 0.9, robot: str = "panda", pushed: bool = False) -> Recording:
    """A swing of the arm that carries the object from a quarter to three quarters of the way, opened and closed.

    Where asked for, the reference is pushed 6 cm to the left meanwhile.
    """
    arm = load_arm(robot)
    share = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, samples))
    joints = arm.home + share[:, None] * swing * np.array([1.0, 0.6, 0.2, 0.5, 0.1, 0.4, 0.3])
    phase = np.minimum(np.arange(samples) * 6 // samples, 5).astype(np.int32)
    held = (phase >= 1) & (phase <= 4)
    opening = np.where(held, 0.04, arm.max_opening_m)
    fingers = np.stack([arm.finger_positions(value) for value in opening])
    tcp = [compose_poses(BASE, pose) for pose in _tcp(arm, joints)]
    grasp = int(np.flatnonzero(held)[0])
    start = Pose(np.array([0.18, 0.05, 0.06]), np.array([1.0, 0.0, 0.0, 0.0]))
    shift = np.array([pose.position - tcp[grasp].position for pose in tcp])
    carried = np.where(held[:, None], shift, shift[np.flatnonzero(held)[-1]] * (phase > 4)[:, None])
    poses = np.concatenate([start.position + carried, np.tile(start.quaternion_wxyz, (samples, 1))], axis=1)
    qpos = np.concatenate([joints, fingers], axis=1).astype(np.float32)
    return Recording(
        robot=robot,
        base=BASE,
        step_s=STEP_S,
        max_disturbed_m=0.02,
        command=np.concatenate([joints, opening[:, None]], axis=1),
        phase=phase,
        time_s=(np.arange(samples) * STEP_S).astype(np.float32),
        qpos=qpos,
        qvel=np.gradient(qpos, STEP_S, axis=0).astype(np.float32),
        tcp=np.array([[*pose.position, *pose.quaternion_wxyz] for pose in tcp], dtype=np.float32),
        object_pose=poses.astype(np.float32),
        pads=np.where(held, 3, 0).astype(np.uint8),
        disturbed_m=np.zeros(samples, dtype=np.float32),
        moved_ids=(Y_ID,) if pushed else (),
        moved_poses=_pushed(samples)[:, :1] if pushed else _pushed(samples)[:, :0],
    )


def _pushed(samples: int) -> np.ndarray:
    way = np.linspace([0.0, 0.0, 0.03], [-0.06, 0.0, 0.03], samples)
    return np.concatenate([way, np.tile([1.0, 0.0, 0.0, 0.0], (samples, 1))], axis=1)[:, None].astype(np.float32)


def _tcp(arm: Arm, joints: np.ndarray) -> list[Pose]:
    """Of the arm alone, whose base stands at the origin."""
    model = arm.spec().compile()
    data = mujoco.MjData(model)
    addresses = [int(model.joint(name).qposadr[0]) for name in arm.joint_names]
    poses = []
    for values in joints:
        data.qpos[addresses] = values
        mujoco.mj_kinematics(model, data)
        site = data.site(arm.tcp_site)
        poses.append(Pose(np.array(site.xpos), quaternion_from_matrix(np.array(site.xmat).reshape(3, 3))))
    return poses or [identity_pose()]


def trajectory_row(scene_id: str, task_id: str, success: bool, **more) -> dict:
    failure = {} if success else {"failed_phase": "grasp", "reason": "not_grasped", "detail": "no finger touched it"}
    return {
        "scene_id": scene_id,
        "task_id": task_id,
        "x_id": X_ID,
        "y_id": Y_ID,
        "relation": "on",
        "instruction": "Put the green block on the red block.",
        "success": success,
        "robot": "panda",
        "grasp_model": "antipodal",
        "planner": "rrt",
        "grasp_stage": 1,
        "grasp_score": 0.9,
        "grasp_candidates": 40,
        "tried": 1,
        "duration_s": 2.0,
        "lifted_m": 0.16,
        "disturbed_m": 0.0,
        "survives": ["friction_halved"],
        "arrays": f"trajectories/{task_id}.npz",
        **failure,
        **more,
    }


def write_recorded_dataset(out: Path, scenes: dict[str, list[tuple[dict, bytes | None]]], photographed=True) -> Path:
    """Two scenes per shard; each scene's rows of trajectories with the bytes of their arrays, or None without."""
    names = sorted(scenes)
    for number in range(0, len(names), 2):
        _write_shard(out, number // 2, {name: scenes[name] for name in names[number : number + 2]}, photographed)
    (out / "run.json").write_text("{}")
    return out


def two_scenes(out: Path, photographed: bool = True) -> Path:
    """A scene with a success and a failure, one with a success and a task for which no motion was found."""
    short = encode_recording(recording(31, swing=-0.5))
    unplanned = {"failed_phase": None, "reason": "no_grasp", "detail": "0 of 2000 candidates", "arrays": None}
    scenes = {
        "a-1": [
            (trajectory_row("a-1", "task_000", True), encode_recording(recording())),
            (trajectory_row("a-1", "task_001", False), short),
        ],
        "b-2": [
            (trajectory_row("b-2", "task_000", True, instruction="Move the green block."), short),
            (trajectory_row("b-2", "task_001", False, **unplanned), None),
        ],
    }
    return write_recorded_dataset(out, scenes, photographed)


def _write_shard(out, number, scenes, photographed):
    certificate = Certificate(0.001, *[0.0] * 6, (), (), (), True, False)
    rows = {"scenes": [], "objects": [], "tasks": [], "trajectories": []}
    path = shard_path(out, "mjcf", number)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        tar = TarShard(file)
        for scene_id, trajectories in scenes.items():
            arrays = {row["arrays"]: data for row, data in trajectories if data is not None}
            files = tuple(sorted({**scene_members(scene_id, photographed), **arrays}.items()))
            offset, size = tar.add(ExportedScene(scene_id, files, certificate, {}, (), ()))
            rows["scenes"].append(_scene_row(scene_id, number, offset, size))
            rows["objects"] += [_object_row(scene_id, object_id) for object_id in (Y_ID, X_ID)]
            keys = ("scene_id", "task_id", "instruction", "x_id", "y_id", "relation")
            rows["tasks"] += [{**{key: row[key] for key in keys}, "accepted": True} for row, _ in trajectories]
            rows["trajectories"] += add_digests([row for row, _ in trajectories], files)
        tar.close()
    schemas = {"scenes": SCENES, "objects": OBJECTS, "tasks": TASKS, "trajectories": TRAJECTORIES}
    for table, schema in schemas.items():
        write_atomic(shard_path(out, table, number), encode_parquet(build_table(rows[table], schema)))


def _scene_row(scene_id, number, offset, size):
    figures = ("piece_penetration_before_m", "mesh_penetration_before_m", "piece_penetration_m", "mesh_penetration_m")
    more = ("drift_m", "drift_rad", "displacement_median_m", "displacement_max_m")
    return {
        "scene_id": scene_id,
        "kind": "capture",
        "name": f"table {scene_id}",
        "source": "made by hand",
        "licence": "CC0-1.0",
        "status": "done",
        "stage": "trajectories",
        "attempts": 1,
        "n_objects": 2,
        "usable": True,
        "quality_score": 8,
        "epsilon_m": 0.001,
        "n_fell": 0,
        "n_left_container": 0,
        "at_rest": True,
        "colliding": False,
        "shard": number,
        "tar_offset": offset,
        "tar_size": size,
        **dict.fromkeys((*figures, *more), 1e-5),
    }


def _object_row(scene_id, object_id):
    name = {Y_ID: "red block", X_ID: "green block"}[object_id]
    sizes = {"size_x_m": 0.1, "size_y_m": 0.1, "size_z_m": 0.1}
    return {"scene_id": scene_id, "object_id": object_id, "label": name, "relabel_name": name, "mass_kg": 0.1, **sizes}
