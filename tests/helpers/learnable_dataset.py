"""A small dataset to learn from: blocks on tables, exported for real, each with a picture, tasks and proven motions."""

import io
from pathlib import Path

import numpy as np
from PIL import Image

from schemas.config import Config
from schemas.curation import TaskAssessment
from schemas.outcome import Done
from schemas.scene import ExportedScene
from schemas.tables import OBJECTS, SCENES, TASKS, TRAJECTORIES
from schemas.trajectories import Motion
from tableverse_factory.core.png import encode_png
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.shards import TarShard, shard_path
from tableverse_factory.dataset.trajectory_files import add_digests, arrays_name
from tableverse_factory.models.services import Services
from tableverse_factory.robotics.execution.arrays import encode_recording
from tableverse_factory.robotics.execution.execute import execute_and_check
from tableverse_factory.robotics.execution.goal import load_goal
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.robotics.robots.station import Station
from tableverse_factory.stages.export.export import export
from tests.helpers.pick_recording import BASE, BLOCK, REFERENCE, STEP_S, pick_and_place
from tests.helpers.simple_scenes import Solid, as_settled, box, curated, layout

LABELS = ("wooden block", "bowl", "tea box")
LICENCES = ("CC0-1.0", "CC-BY-4.0", "CC-BY-NC-4.0")
TASKED = (("task_000", "next to", True), ("task_001", "to the right of", True), ("task_002", "on", False))


def write_learnable_dataset(
    out: Path,
    scenes: int = 6,
    shard_size: int = 2,
    moved: int = 1,
    splits: tuple[str, ...] = (),
    names: tuple[str, ...] = (),
) -> Path:
    """Scenes `s-0`, `s-1`, … that differ in where a bystander stands; `moved` have a motion for each of two tasks.

    The first ones are of `splits`, where given; a judge calls the objects `names`, else as they are labelled.
    """
    exported = [
        _exported(k, with_motions=k < moved, split=splits[k] if k < len(splits) else None, names=names)
        for k in range(scenes)
    ]
    for number in range(0, scenes, shard_size):
        _write_shard(out, number // shard_size, exported[number : number + shard_size])
    (out / "run.json").write_text("{}")
    return out


def _exported(k: int, with_motions: bool, split: str | None, names: tuple[str, ...]) -> ExportedScene:
    solids = [
        Solid(box(0.04, 0.04, 0.06), (0.0, 0.0, 0.03), LABELS[0]),
        Solid(box(0.08, 0.08, 0.04), (0.18, 0.1, 0.02), LABELS[1]),
        Solid(box(0.03, 0.03, 0.1), (-0.25 + 0.02 * k, 0.15, 0.05), LABELS[2]),
    ]
    tasks = tuple(
        TaskAssessment(
            task_id=task_id, instruction=f"Pick up the wooden block and place it {relation} the bowl", x_id=BLOCK,
            y_id=REFERENCE, relation=relation, source="rules", accepted=accepted,
            refusal="" if accepted else "too_small",
        )
        for task_id, relation, accepted in TASKED
    )  # fmt: skip
    made = curated(as_settled(layout(solids, scene_id=f"s-{k}")), 0.1 * (k + 1), tasks, names)
    outcome = export(made, Config(), np.random.default_rng(0), Services(Path("unused")))
    assert isinstance(outcome, Done)
    value = outcome.value
    files = {**dict(value.files), **_pictures(k)}
    motions = _motions(files) if with_motions else []
    files |= {row["arrays"]: data for row, data in motions}
    rows = add_digests([{**row, "scene_id": f"s-{k}"} for row, _ in motions], tuple(files.items()))
    row = {
        **value.scene_row, "kind": "capture", "name": f"table {k}", "licence": LICENCES[k % 3], "status": "done",
        "stage": "export", "attempts": 1, "n_trajectories": len(rows), "n_successes": sum(r["success"] for r in rows),
        "split": split,
    }  # fmt: skip
    objects = tuple({**item, "graspable": item["object_id"] != REFERENCE} for item in value.object_rows)
    return ExportedScene(
        f"s-{k}", tuple(sorted(files.items())), value.certificate, row, objects, value.task_rows, tuple(rows)
    )


def _pictures(k: int) -> dict[str, bytes]:
    """A photograph of one colour, with one object seen in its middle."""
    file = io.BytesIO()
    Image.new("RGB", (64, 48), (40 * k, 100, 200)).save(file, "JPEG")
    masks = np.zeros((48, 64), dtype=np.uint8)
    masks[16:32, 16:48] = 1
    return {"observation/color.jpg": file.getvalue(), "observation/masks.png": encode_png(masks)}


def _from_home() -> Motion:
    """The arm comes from where it waits, as in every motion that is planned."""
    motion, home = pick_and_place(), np.array(load_arm("panda").home)
    share = np.linspace(0.0, 1.0, 100)[:-1]
    smooth = 10 * share**3 - 15 * share**4 + 6 * share**5
    path = np.concatenate([home + smooth[:, None] * (motion.positions[0] - home), motion.positions])
    return Motion(
        STEP_S,
        path,
        np.gradient(path, STEP_S, axis=0),
        np.concatenate([np.full(len(share), motion.openings[0]), motion.openings]),
        np.concatenate([np.zeros(len(share), dtype=np.int32), motion.phases]),
    )


def _motions(files: dict[str, bytes]) -> list[tuple[dict, bytes]]:
    """The same motion for both tasks: it leads to the left of the bowl, and so one succeeds and one fails."""
    station, motions = Station(files, load_arm("panda"), BASE), []
    for task_id, relation, accepted in TASKED:
        if not accepted:
            continue
        told = {"task_id": task_id, "x_id": BLOCK, "y_id": REFERENCE, "relation": relation}
        proof = execute_and_check(station, BASE, _from_home(), load_goal(files, told, 0.02))
        verdict = proof.verdict
        row = {
            **told, "instruction": f"Pick up the wooden block and place it {relation} the bowl",
            "success": verdict.success, "failed_phase": verdict.failed_phase or None, "reason": verdict.reason or None,
            "detail": verdict.detail or None, "robot": "panda", "grasp_model": "antipodal", "planner": "rrt",
            "base_x_m": BASE.position[0], "base_y_m": BASE.position[1], "base_z_m": 0.0, "base_yaw_rad": np.pi / 2,
            "duration_s": STEP_S * len(proof.recording), "lifted_m": verdict.lifted_m,
            "disturbed_m": verdict.disturbed_m, "survives": [], "arrays": arrays_name(task_id),
        }  # fmt: skip
        motions.append((row, encode_recording(proof.recording)))
    assert [row["success"] for row, _ in motions] == [True, False]
    return motions


def _write_shard(out: Path, number: int, scenes: list[ExportedScene]) -> None:
    path = shard_path(out, "mjcf", number)
    path.parent.mkdir(parents=True, exist_ok=True)
    tables = {"scenes": [], "objects": [], "tasks": [], "trajectories": []}
    with path.open("wb") as file:
        tar = TarShard(file)
        for scene in scenes:
            offset, size = tar.add(scene)
            place = {"shard": number, "tar_offset": offset, "tar_size": size}
            tables["scenes"].append({**scene.scene_row, **place})
            tables["objects"] += scene.object_rows
            tables["tasks"] += scene.task_rows
            tables["trajectories"] += scene.trajectory_rows
        tar.close()
    schemas = {"scenes": SCENES, "objects": OBJECTS, "tasks": TASKS, "trajectories": TRAJECTORIES}
    for table, schema in schemas.items():
        if tables[table] or table != "trajectories":
            write_atomic(shard_path(out, table, number), encode_parquet(build_table(tables[table], schema)))
