"""How many tasks of a dataset were tried by a robot, and where the others failed, over its committed shards."""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from schemas.arrow import TRAJECTORIES
from tableverse_factory.core.storage.files import StoragePath, list_names
from tableverse_factory.dataset.shards import read_shard, shard_name, shard_path

_COLUMNS = ("success", "failed_phase", "reason")
BEFORE = "before any motion"
"""Where a task failed that no motion was found for."""


@dataclass(frozen=True, slots=True)
class TrajectorySummary:
    """What became of the tasks.

    Attributes:
        tasks: That were tried.
        succeeded: Those of them that succeeded in simulation.
        failed: The others by phase and reason, the most frequent first.
    """

    tasks: int
    succeeded: int
    failed: Mapping[tuple[str, str], int]


def summarize_trajectories(out: StoragePath, shards: Sequence[int]) -> TrajectorySummary:
    """Reads the trajectories of these committed shards."""
    there = set(list_names(out / "trajectories"))
    tasks, succeeded, failed = 0, 0, Counter[tuple[str, str]]()
    for number in (number for number in shards if shard_name("trajectories", number) in there):
        with suppress(FileNotFoundError):  # a shard that is being written again counts when it is back
            rows = read_shard(shard_path(out, "trajectories", number), TRAJECTORIES, _COLUMNS).to_pylist()
            tasks += len(rows)
            succeeded += sum(bool(row["success"]) for row in rows)
            failed.update((row["failed_phase"] or BEFORE, row["reason"] or "") for row in rows if not row["success"])
    return TrajectorySummary(tasks, succeeded, dict(sorted(failed.items(), key=lambda item: (-item[1], item[0]))))
