"""Overview of a dataset as files: `overview.png`, `overview.svg`, `statistics.json`."""

import json
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.apart import require_apart
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.viz.destination import find_local_folder
from tableverse_factory.viz.funnel import FunnelStep, compute_funnel
from tableverse_factory.viz.overview.dataset_statistics import Statistics, compute_statistics
from tableverse_factory.viz.overview.figure import draw_overview


def write_statistics(dataset: Dataset, dest: Path) -> tuple[Path, ...]:
    """Write the statistics of the committed shards into a folder apart from the dataset; return the files' paths."""
    if dest.exists() and not dest.is_dir():
        raise InputError(f"{dest}: a file; give a folder")
    if (folder := find_local_folder(dataset.path)) is not None:
        require_apart(dest, folder, may_hold=True)
    statistics, steps, content = _compute_all(dataset)
    files = {
        "statistics.json": (json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n").encode(),
        "overview.svg": draw_overview(statistics, steps, "svg"),
        "overview.png": draw_overview(statistics, steps, "png"),
    }
    dest.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        write_atomic(dest / name, data)
    return tuple(dest / name for name in files)


def make_report(dataset: Dataset) -> dict[str, Any]:
    """Make the content of `statistics.json`."""
    return _compute_all(dataset)[2]


def _compute_all(dataset: Dataset) -> tuple[Statistics, tuple[FunnelStep, ...], dict[str, Any]]:
    statistics = compute_statistics(dataset)
    kinds = {kind for rows in dataset.scenes.to_batches(columns=["kind"]) for kind in rows["kind"].unique().to_pylist()}
    steps = compute_funnel(statistics.scenes["entered"], statistics.losses, kinds)
    funnel = [
        {"stage": step.stage, "left": step.left} | {status: step.count_lost(status) for status in ("dropped", "failed")}
        for step in steps
    ]
    return statistics, steps, {**statistics.to_json(), "funnel": funnel}
