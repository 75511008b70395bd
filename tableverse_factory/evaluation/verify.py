"""A dataset against what it claims: every scene measured again, and its motions executed again from their arrays."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from typing import Any

import pyarrow.compute as pc

from schemas.arrow import TABLES
from schemas.config import TrajectoriesConfig
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.dataset.trajectory_files import changed, misfits
from tableverse_factory.evaluation.scene_audit import Audit, audit_scene
from tableverse_factory.rebuild import config_from_run
from tableverse_factory.robotics.execution.audit import audit_trajectories
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.registry import arm_of

Row = Mapping[str, Any]

SCENES_PER_PROCESS = 4
"""Fewer are not worth another process: one takes as long to start as two to measure."""


@dataclass(frozen=True, slots=True)
class Replays:
    """What replaying a dataset's motions needs to know.

    Attributes:
        arm: Of those whose robot came from a file.
        config: What they were made with, by run.json.
        tasks: Rows of tasks/ by scene.
    """

    arm: Arm | None
    config: TrajectoriesConfig
    tasks: Mapping[str, Sequence[Row]]

    def added_to(self, audit: Audit, files: Mapping[str, bytes], rows: Sequence[Row]) -> Audit:
        """The audit of a scene with that of its trajectories."""
        tasks = self.tasks.get(audit.scene_id, ())
        known = set(audit.problems)
        unfit = misfits(rows, files, [task["task_id"] for task in tasks if task["accepted"]])
        audit = replace(audit, problems=(*audit.problems, *(line for line in unfit if line not in known)))
        replays = audit_trajectories(files, rows, self.arm, tasks, self.config)
        problems = [f"{replay.task_id}: {problem}" for replay in replays for problem in replay.problems]
        measured = {**audit.measured, "trajectories": [asdict(replay) for replay in replays]}
        return replace(audit, measured=measured, problems=(*audit.problems, *problems))


def verify_scenes(path: str, jobs: int, trajectories: bool = False, robot: str | None = None) -> Iterator[Audit]:
    """What is found in every scene of a dataset that is done, in the order of its rows.

    Args:
        path: Of the dataset, as `open_dataset` takes it.
        jobs: At most so many processes measure.
        trajectories: Whether motions are replayed.
        robot: The arm of those whose robot came from a file.

    Raises:
        InputError: if there is no dataset, it has lost a table, or there is nothing in it to look at.
        ConfigError: if its motions were made with keys that this version does not know, or there is no such robot.
    """
    dataset = open_dataset(path)
    for table in TABLES:  # a shard that has lost one is not whole, even where each of its scenes is
        try:
            dataset.table(table)
        except InputError as error:
            raise InputError(
                f"{error}: delete the file of that name in scenes/, and the same build makes the shard again"
            ) from None
    done = dataset.scenes.to_table(filter=pc.field("status") == "done", columns=["scene_id"])
    if not done.num_rows:
        raise InputError(f"{path}: no scene is done, so there is nothing to verify; see `tableverse failures {path}`")
    if trajectories and not dataset.trajectories.count_rows():
        raise InputError(f"{path}: no trajectories in it to replay; `tableverse trajectories {path}` adds them")
    _opened.cache_clear()  # what an earlier call in this process has seen may have changed
    _replays.cache_clear()
    if trajectories:
        _replays(path, robot)  # an error of all scenes is said before the first
    ids = done.column(0).to_pylist()
    work = partial(_audit, path, trajectories, robot)
    yield from parallel_map(work, ids, min(jobs, -(-len(ids) // SCENES_PER_PROCESS)), "measures scenes again")


def _audit(path: str, trajectories: bool, robot: str | None, scene_id: str) -> Audit:
    try:
        scene = _opened(path).scene(scene_id)
        files, rows = scene.files(), scene.trajectory_rows()
    except InputError as error:
        return Audit(scene_id, {}, (str(error),))
    audit = audit_scene(scene_id, files, scene.row)
    audit = replace(audit, problems=(*audit.problems, *changed(rows, files, scene.row)))
    return _replays(path, robot).added_to(audit, files, rows) if trajectories else audit


# A process opens the dataset once, not once a scene; another one may be looked at after it.
@lru_cache(maxsize=1)
def _opened(path: str) -> Dataset:
    return open_dataset(path)


@lru_cache(maxsize=1)
def _replays(path: str, robot: str | None) -> Replays:
    tasks: dict[str, list[Row]] = {}
    for task in _opened(path).tasks.to_table().to_pylist():
        tasks.setdefault(str(task["scene_id"]), []).append(task)
    run = _opened(path).record()
    if run is None:
        raise InputError(f"{path}: there is no run.json, which says what its motions were made with", "bad_run")
    return Replays(arm_of(robot) if robot else None, config_from_run(run, "trajectories").trajectories, tasks)
