"""Stage TRAJECTORIES: for every accepted task a motion that succeeds in physics, or the reason why there is none.

Each task runs in a forked process (`fork_pool`), so a planner that crashes or hangs costs only its own task.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from schemas.codec import decode, encode
from schemas.config import Config
from schemas.outcome import Done, Outcome
from schemas.scene import ExportedScene
from tableverse_factory.dataset.trajectory_files import add_trajectories, arrays_name
from tableverse_factory.models.services import Services
from tableverse_factory.robotics.execution.arrays import encode_recording
from tableverse_factory.robotics.robots.reach import compute_reach_map
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.stages.trajectories.failed_rows import build_failed_row, select_accepted_tasks
from tableverse_factory.stages.trajectories.fork_pool import ItemFailure, map_in_fork
from tableverse_factory.stages.trajectories.rows import build_trajectory_row
from tableverse_factory.stages.trajectories.search import search_trajectory
from tableverse_factory.stages.trajectories.work_cell import WorkCell


def plan_trajectories(
    scene: ExportedScene, config: Config, rng: np.random.Generator, services: Services
) -> Outcome[ExportedScene]:
    """Add a row per accepted task, and a file of arrays for each executed motion; a scene never fails here."""
    settings = config.trajectories
    tasks = select_accepted_tasks(scene, settings)
    for_things, for_tasks = rng.spawn(2)
    if not tasks:
        return Done(add_trajectories(scene, ()))
    arm = load_arm(settings.robot)
    compute_reach_map(arm)  # once, here, for all of the processes apart
    cell = WorkCell(dict(scene.files), scene.object_rows, arm, settings, for_things, services)
    streams = for_tasks.spawn(len(tasks))

    def work(index: int) -> bytes:
        return encode(_plan_task(cell, tasks[index], config, streams[index]))

    answers = map_in_fork(work, len(tasks), settings.task_deadline_s, config.run.memory_mb)
    rows: list[dict[str, Any]] = []
    files: dict[str, bytes] = {}
    for task, answer in zip(tasks, answers, strict=True):
        if isinstance(answer, ItemFailure):
            rows.append(build_failed_row(task, settings, answer.kind, answer.detail))
            continue
        row, arrays = decode(answer)
        rows.append(row)
        if row["arrays"] is not None:
            files[row["arrays"]] = arrays
    return Done(add_trajectories(scene, rows, files))


def _plan_task(
    cell: WorkCell, task: Mapping[str, Any], config: Config, rng: np.random.Generator
) -> tuple[dict[str, Any], bytes]:
    """Plan one task; return its row and arrays, empty if nothing was executed."""
    found = search_trajectory(cell, task, rng)
    proof = None if found.attempt is None else found.attempt.proof
    name = None if proof is None else arrays_name(task["task_id"])
    arrays = b"" if proof is None else encode_recording(proof.recording)
    return build_trajectory_row(task, config.trajectories, found, name), arrays
