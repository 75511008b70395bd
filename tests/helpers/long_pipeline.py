"""The tiny pipeline with a stage behind it that plans, and crashes and hangs where a row's `name` says so."""

import json
import os
import time
from dataclasses import asdict, replace

import tableverse_factory.dataset.committed_scene  # noqa: F401 no deadline of a stage pays for what reads scenes back
from schemas.manifest import SceneKind
from schemas.outcome import Done, Dropped
from tableverse_factory.core.errors import ModelError
from tableverse_factory.dataset.trajectory_files import add_trajectories
from tableverse_factory.stage import Stage
from tableverse_factory.stages.trajectories.failed_rows import with_failed_trajectories
from tests.helpers import tiny_pipeline
from tests.helpers.tiny_pipeline import _mark


def pack(item, config, rng, services):
    scene = tiny_pipeline.pack(item, config, rng, services).value
    meta = {"format": "tableverse-scene-1", "certificate": asdict(scene.certificate), "objects": [], "files": {}}
    names = {"name": item["name"]}
    files = {**dict(scene.files), "meta.json": json.dumps({**meta, **names}).encode()}
    accepted = item["name"] != "idle"
    tasks = [{"scene_id": scene.scene_id, "task_id": f"task_{k:03d}", "accepted": accepted} for k in range(2)]
    return Done(replace(scene, files=tuple(sorted(files.items())), task_rows=tuple(tasks)))


def plan(scene, config, rng, services):
    before = _mark("plan", scene.scene_id)
    name = json.loads(dict(scene.files)["meta.json"])["name"]
    if name.startswith("long_plan"):
        time.sleep(2.0)
    if name == "hang_plan":
        time.sleep(3600)
    if name == "crash_plan" or (name == "crash_plan_once" and before == 0):
        os._exit(3)
    if name.startswith("mute_plan") and not os.environ.get("TINY_LINE_ANSWERS"):
        raise ModelError("the grasp server does not answer")
    if name == "drop_plan":
        return Dropped("no_robot", "there is no robot")
    files, rows = {}, []
    for task in [task for task in scene.task_rows if task["accepted"]][: config.trajectories.max_tasks]:
        success = task["task_id"] == "task_000"
        named = f"trajectories/{task['task_id']}.npz" if success else None
        row = {"scene_id": scene.scene_id, "task_id": task["task_id"], "success": success, "arrays": named}
        if success:
            files[named] = rng.bytes(300)
        else:
            row |= {"failed_phase": "grasp", "reason": "no_grasp"}
        rows.append({**row, "robot": config.trajectories.robot})
    return Done(add_trajectories(scene, rows, files))


_SHORT = (*tiny_pipeline._STAGES[:3], Stage("pack", "curation", pack, reads=("export",)))
_TRAJECTORIES = Stage(
    "trajectories", "trajectories", plan, reads=("trajectories",), record_failure=with_failed_trajectories
)
_LONG = (*_SHORT, _TRAJECTORIES)
SHORT = dict.fromkeys(SceneKind, _SHORT)
LONG = dict.fromkeys(SceneKind, _LONG)
