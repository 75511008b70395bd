"""The overview of a dataset as files: `overview.png`, `overview.svg`, `statistics.json`."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tableverse_factory import pipeline
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.viz.overview.figure import overview
from tableverse_factory.viz.overview.funnel import FunnelStep, funnel
from tableverse_factory.viz.overview.gather import Statistics, gather


def write_statistics(dataset: Dataset, dest: Path) -> tuple[Path, ...]:
    """Counts the dataset and writes the files, over those of an earlier call; returns their paths.

    Args:
        dataset: Finished or not; only committed shards count.
        dest: A folder, made where it is not there.

    Raises:
        InputError: if `dest` is no folder or lies within the dataset.
    """
    root = Path(dataset.path).resolve()
    if dest.exists() and not dest.is_dir():
        raise InputError(f"{dest}: a file; give a folder")
    if root == dest.resolve() or root in dest.resolve().parents:
        raise InputError(f"{dest}: lies within the dataset, whose bytes stay as they were built; give another folder")
    statistics, steps = _counted(dataset)
    content = _content(statistics, steps)
    files = {
        "statistics.json": (json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n").encode(),
        "overview.svg": overview(statistics, steps, "svg"),
        "overview.png": overview(statistics, steps, "png"),
    }
    dest.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        write_atomic(dest / name, data)
    return tuple(dest / name for name in files)


def figures(dataset: Dataset) -> dict[str, Any]:
    """What `statistics.json` says."""
    return _content(*_counted(dataset))


def _counted(dataset: Dataset) -> tuple[Statistics, tuple[FunnelStep, ...]]:
    statistics = gather(dataset)
    return statistics, funnel(statistics.scenes["entered"], statistics.losses, stages_of(statistics))


def stages_of(statistics: Statistics) -> tuple[str, ...]:
    """The stages through which scenes of this dataset went, in order: layouts begin elsewhere than pictures."""
    kinds = {name for name, _ in statistics.kinds.top}
    lines = [line for kind, line in pipeline.PIPELINES.items() if kind.value in kinds] or [pipeline.STAGES]
    shared = [stage.name for stage in lines[0] if all(stage in line for line in lines)]
    own = [stage.name for line in lines for stage in line if stage.name not in shared]
    return (*dict.fromkeys(own), *shared)


def _content(statistics: Statistics, steps: Sequence[FunnelStep]) -> dict[str, Any]:
    return {**statistics.to_json(), "funnel": [asdict(step) for step in steps]}


def default_dest(out: str) -> Path:
    """Beside the dataset: its own bytes stay as they were built."""
    path = Path(out.rstrip("/").rpartition("/")[2]) if "://" in out else Path(out).resolve()
    return path.with_name(f"{path.name}-statistics")
