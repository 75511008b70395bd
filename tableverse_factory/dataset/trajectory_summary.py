"""Summary of a dataset's trajectories: how many tasks a robot tried, and where the others failed."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.dataset.committed_rows import read_rows

BEFORE = "before any motion"  # phase of a task that failed because no motion was found for it


@dataclass(frozen=True, slots=True)
class TrajectorySummary:
    """Outcomes of the tasks."""

    tasks: int  # tried
    succeeded: int  # in simulation
    failed: Mapping[tuple[str, str], int]  # the others by phase and reason, the most frequent first


def summarize_trajectories(out: StoragePath, shards: Sequence[int]) -> TrajectorySummary:
    """Summarize the trajectories of these committed shards."""
    rows = list(read_rows(out, "trajectories", shards, ("success", "failed_phase", "reason")))
    failed = Counter((row["failed_phase"] or BEFORE, row["reason"] or "") for row in rows if not row["success"])
    by_count = dict(sorted(failed.items(), key=lambda item: (-item[1], item[0])))
    return TrajectorySummary(len(rows), len(rows) - failed.total(), by_count)
