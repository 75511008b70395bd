"""Summary of a dataset's trajectories: how many tasks a robot tried, and where the others failed."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pyarrow.compute as pc

from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.dataset.columns import count_groups
from tableverse_factory.dataset.committed_rows import read_columns

BEFORE = "before any motion"  # phase of a task that failed because no motion was found for it


@dataclass(frozen=True, slots=True)
class TrajectorySummary:
    """Outcomes of the tasks."""

    tasks: int  # tried
    succeeded: int  # in simulation
    failed: Mapping[tuple[str, str], int]  # the others by phase and reason, the most frequent first


def summarize_trajectories(out: StoragePath, shards: Sequence[int]) -> TrajectorySummary:
    """Summarize the trajectories of these committed shards."""
    rows = read_columns(out, "trajectories", shards, ("success", "failed_phase", "reason"))
    lost = rows.filter(pc.invert(rows["success"].fill_null(False)))
    failed = Counter[tuple[str, str]]()
    for (phase, reason), count in count_groups(lost, ("failed_phase", "reason")).items():
        failed[phase or BEFORE, reason or ""] += count
    by_count = dict(sorted(failed.items(), key=lambda item: (-item[1], item[0])))
    return TrajectorySummary(rows.num_rows, rows.num_rows - lost.num_rows, by_count)
