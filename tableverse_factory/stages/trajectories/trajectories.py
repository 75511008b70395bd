"""TRAJECTORIES: for every accepted task of an exported scene a motion that physics has agreed to, or why there is none.

What a task costs where its planner crashes or hangs is that task: each runs in a process apart (`apart.py`).
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from schemas.codec import decode, encode
from schemas.config import Config
from schemas.outcome import Done, Outcome
from schemas.scene import ExportedScene
from tableverse_factory.dataset.trajectory_files import arrays_name
from tableverse_factory.models.services import Services
from tableverse_factory.robotics.execution.arrays import arrays_bytes
from tableverse_factory.robotics.robots.reach import reach_of
from tableverse_factory.robotics.robots.registry import arm_of
from tableverse_factory.stages.trajectories.failed_rows import accepted_tasks, failed_row
from tableverse_factory.stages.trajectories.fork_pool import ItemFailure, map_in_fork
from tableverse_factory.stages.trajectories.rows import trajectory_row
from tableverse_factory.stages.trajectories.search import search
from tableverse_factory.stages.trajectories.work_cell import WorkCell


def trajectories(
    scene: ExportedScene, config: Config, rng: np.random.Generator, services: Services
) -> Outcome[ExportedScene]:
    """The scene with a row per accepted task, and a file of arrays for each motion that was executed.

    A scene is never lost here: a task without a trajectory has its reason in its row.

    Raises:
        InputError: if the files are not those of an exported scene.
        ConfigError: if there is no such robot, or its planner knows none of it.
        ModelError: if the grasp model or the planner does not answer: no task is to blame, and none gets a row for it.
    """
    settings = config.trajectories
    tasks = accepted_tasks(scene, settings)
    for_things, for_tasks = rng.spawn(2)
    if not tasks:
        return Done(replace(scene, trajectory_rows=()))
    arm = arm_of(settings.robot)
    reach_of(arm)  # once, here, for all of the processes apart
    cell = WorkCell(scene, arm, settings, for_things, services)
    streams = for_tasks.spawn(len(tasks))

    def work(index: int) -> bytes:
        return encode(_trajectory(cell, tasks[index], config, streams[index]))

    answers = map_in_fork(work, len(tasks), settings.task_deadline_s, config.run.memory_mb)
    rows, files = [], dict(scene.files)
    for task, answer in zip(tasks, answers, strict=True):
        if isinstance(answer, ItemFailure):
            rows.append(failed_row(task, settings, answer.kind, answer.detail))
            continue
        row, arrays = decode(answer)
        rows.append(row)
        if row["arrays"] is not None:
            files[row["arrays"]] = arrays
    return Done(replace(scene, files=tuple(sorted(files.items())), trajectory_rows=tuple(rows)))


def _trajectory(
    cell: WorkCell, task: Mapping[str, Any], config: Config, rng: np.random.Generator
) -> tuple[dict[str, Any], bytes]:
    """Row and arrays of one task; no bytes where nothing was executed."""
    found = search(cell, task, config.trajectories, rng)
    proof = None if found.attempt is None else found.attempt.proof
    name = None if proof is None else arrays_name(task["task_id"])
    arrays = b"" if proof is None else arrays_bytes(proof.recording)
    return trajectory_row(task, config.trajectories, found, name), arrays
