"""Verification of a dataset: measure every scene again, and replay its trajectories from their arrays."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds

from schemas.config import TrajectoriesConfig
from schemas.tables import TABLES
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.dataset.shards import SPARSE
from tableverse_factory.dataset.trajectory_files import find_changes, find_misfits
from tableverse_factory.evaluation.scene_audit import SceneAudit, audit_scene
from tableverse_factory.rebuild import config_from_run
from tableverse_factory.robotics.execution.audit import audit_trajectories
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.registry import load_arm

Row = Mapping[str, Any]

SCENES_PER_PROCESS = 4  # least scenes per process: the start of a process takes as long as measuring two


@dataclass(frozen=True, slots=True)
class ReplayContext:
    """Context for replaying the trajectories of a dataset."""

    arm: Arm | None  # of trajectories whose robot came from a file
    config: TrajectoriesConfig  # from run.json
    tasks: Mapping[str, Sequence[Row]]  # rows of tasks/ by scene

    def replay(self, audit: SceneAudit, files: Mapping[str, bytes], rows: Sequence[Row]) -> SceneAudit:
        """Add the audit of the trajectories to that of their scene."""
        tasks = self.tasks.get(audit.scene_id, ())
        known = set(audit.problems)
        unfit = find_misfits(rows, files, [task["task_id"] for task in tasks if task["accepted"]])
        audit = replace(audit, problems=(*audit.problems, *(line for line in unfit if line not in known)))
        replays = audit_trajectories(files, rows, self.arm, tasks, self.config)
        problems = [f"{replay.task_id}: {problem}" for replay in replays for problem in replay.problems]
        measured = {**audit.measured, "trajectories": [asdict(replay) for replay in replays]}
        return replace(audit, measured=measured, problems=(*audit.problems, *problems))


def verify_scenes(path: str, jobs: int, trajectories: bool = False, robot: str | None = None) -> Iterator[SceneAudit]:
    """Audit every finished scene of a dataset in the order of its rows, and replay its trajectories if asked to.

    `robot` is the arm of trajectories whose robot came from a file. A missing table, or nothing to verify, is an error.
    """
    dataset = open_dataset(path)
    for table in TABLES:  # a missing table damages the shard even if its scenes are whole
        try:
            fragments = dataset.table(table).get_fragments()
            for fragment in () if table in SPARSE else fragments:  # damaged trajectories cost only their scenes
                if isinstance(fragment, ds.ParquetFileFragment):
                    fragment.ensure_complete_metadata()
        except (InputError, OSError, pa.ArrowException) as error:
            raise InputError(
                f"{error}: delete the file of that name in scenes/, and the same build makes the shard again"
            ) from None
    done = dataset.scenes.to_table(filter=pc.field("status") == "done", columns=["scene_id"])
    if not done.num_rows:
        raise InputError(f"{path}: no finished scene to verify; see `tableverse status {path}`")
    if trajectories and not dataset.trajectories.count_rows():
        raise InputError(f"{path}: no trajectories to replay; `tableverse trajectories {path}` adds them")
    _open_dataset.cache_clear()  # the dataset may have changed since an earlier call
    _load_replay_context.cache_clear()
    if trajectories:
        _load_replay_context(path, robot)  # report errors of the whole dataset before the first scene
    ids = done.column(0).to_pylist()
    work = partial(_audit_scene, path, trajectories, robot)
    yield from parallel_map(work, ids, min(jobs, -(-len(ids) // SCENES_PER_PROCESS)), "measures scenes again")


def _audit_scene(path: str, trajectories: bool, robot: str | None, scene_id: str) -> SceneAudit:
    try:
        scene = _open_dataset(path).scene(scene_id)
        files, rows = scene.files(), scene.trajectory_rows()
    except InputError as error:
        return SceneAudit(scene_id, {}, (str(error),))
    audit = audit_scene(scene_id, files, scene.row)
    audit = replace(audit, problems=(*audit.problems, *find_changes(rows, files, scene.row)))
    return _load_replay_context(path, robot).replay(audit, files, rows) if trajectories else audit


# Opened once per process; a later call may verify another dataset.
@lru_cache(maxsize=1)
def _open_dataset(path: str) -> Dataset:
    return open_dataset(path)


@lru_cache(maxsize=1)
def _load_replay_context(path: str, robot: str | None) -> ReplayContext:
    tasks: dict[str, list[Row]] = {}
    for task in _open_dataset(path).tasks.to_table().to_pylist():
        tasks.setdefault(str(task["scene_id"]), []).append(task)
    run = _open_dataset(path).record()
    if run is None:
        raise InputError(f"{path}: no run.json, which holds the configuration of its trajectories", "bad_run")
    return ReplayContext(load_arm(robot) if robot else None, config_from_run(run, "trajectories").trajectories, tasks)
