"""LeRobot datasets, version 3.0, by pyarrow and PyAV alone: the package `lerobot` is not needed to write them.

    DEST/meta/info.json, stats.json, tasks.parquet
    DEST/meta/episodes/chunk-000/file-000.parquet     a row per episode: where its frames lie, and its figures
    DEST/data/chunk-000/file-000.parquet              a row per frame, many episodes in a file
    DEST/videos/KEY/chunk-000/file-000.mp4            the same frames as one camera sees them

The layout is that of the public documentation of LeRobotDataset v3.0.
"""

import tempfile
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.delivery.episodes.frames import features, stride
from tableverse_factory.delivery.episodes.lerobot_files import LeRobotFiles
from tableverse_factory.delivery.episodes.render_workers import ROBOT_CAMERA, SCENE_CAMERA, RenderSetting, shots
from tableverse_factory.delivery.episodes.robot import recorded_arm
from tableverse_factory.delivery.episodes.selection import (
    Episode,
    check_new,
    instruction_of,
    kind_of,
    open_episode,
    selected_rows,
)
from tableverse_factory.delivery.episodes.video import need_av

_CAMERAS = {"robot": ROBOT_CAMERA, "scene": SCENE_CAMERA}


@dataclass(frozen=True, slots=True)
class Options:
    """How episodes are exported.

    Attributes:
        failed: Failures too.
        width: Of the pictures [px], even.
        height: Of the pictures [px], even.
        fps: Frames per second; None for all that were recorded.
        cameras: Of `robot` and `scene`. The latter is the photograph's, which the arm hides where it stands there.
        jobs: Processes that draw.
        robot: The arm of recordings whose robot is none of ours: a file, or `menagerie:NAME`.
    """

    failed: bool = False
    width: int = 320
    height: int = 240
    fps: int | None = None
    cameras: tuple[str, ...] = ("robot",)
    jobs: int = 1
    robot: str | None = None


@dataclass(frozen=True, slots=True)
class Written:
    """What was exported."""

    episodes: int
    frames: int
    cameras: tuple[str, ...]


def export_lerobot(
    dataset: Dataset, dest: Path, options: Options, progress: Callable[[int, int], None] | None = None
) -> Written:
    """Writes the trajectories of a dataset to a new folder, which appears when it is complete.

    The same dataset and options give the same bytes, however many processes draw.

    Args:
        dataset: With trajectories.
        dest: A folder that does not exist yet.
        options: What and how.
        progress: Called with the number of episodes written and of all.

    Raises:
        InputError: if `dest` exists, there is nothing to export, the episodes are of several robots or steps, a
            camera is asked for that a scene lacks, PyAV is missing, or as `recorded_arm`.
    """
    need_av()
    check_new(dest)
    rows = selected_rows(dataset, options.failed)
    first = open_episode(dataset, rows[0])
    setting, arm = _setting(first, options), recorded_arm(first.recording, options.robot)
    licences = _licences(dataset)
    dest = dest.absolute()
    dest.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{dest.name}-", dir=dest.parent) as scratch:
        files = LeRobotFiles(Path(scratch) / "dataset", setting, features(arm))
        with closing(files):
            for row, shot in zip(rows, shots(dataset.path, setting, rows, options.jobs), strict=True):
                files.add(instruction_of(row), shot, _origin(row, licences))
                if progress is not None:
                    progress(files.n_episodes, len(rows))
            files.finish().rename(dest)
    return Written(files.n_episodes, files.n_frames, setting.cameras)


def _setting(first: Episode, options: Options) -> RenderSetting:
    """What is the same for all episodes."""
    if options.width % 2 or options.height % 2:
        raise InputError(f"{options.width} × {options.height}: the sides of a video are even", "bad_size")
    every, fps = stride(first.recording, options.fps)
    cameras = tuple(_CAMERAS[name] for name in options.cameras)
    return RenderSetting(kind_of(first), cameras, options.width, options.height, every, fps, options.robot)


def _licences(dataset: Dataset) -> dict[str, str]:
    table = dataset.scenes.to_table(columns=["scene_id", "licence"])
    return {row["scene_id"]: row["licence"] or "" for row in table.to_pylist()}


def _origin(row: Mapping[str, Any], licences: Mapping[str, str]) -> dict[str, Any]:
    """Columns of meta/episodes that LeRobot does not know: where an episode comes from, and how it ended."""
    return {
        "scene_id": row["scene_id"],
        "task_id": row["task_id"],
        "relation": row["relation"] or "",
        "success": bool(row["success"]),
        "failed_phase": row["failed_phase"] or "",
        "reason": row["reason"] or "",
        "licence": licences.get(row["scene_id"], ""),
    }
