"""LeRobot datasets, version 3.0, by pyarrow and PyAV, without the package `lerobot`.

    DEST/README.md                                    the dataset card
    DEST/meta/info.json, stats.json, tasks.parquet
    DEST/meta/episodes/chunk-000/file-000.parquet     a row per episode: where its frames lie, and its statistics
    DEST/data/chunk-000/file-000.parquet              a row per frame, many episodes in a file
    DEST/videos/KEY/chunk-000/file-000.mp4            the same frames as pictures

The layout is that of the public documentation.
"""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.dataset.splits import SPLITS, get_split
from tableverse_factory.delivery.episodes.frames import compute_stride, list_features
from tableverse_factory.delivery.episodes.instructions import paraphrase_instruction, read_instruction
from tableverse_factory.delivery.episodes.lerobot_files import LeRobotFiles
from tableverse_factory.delivery.episodes.observation import count_object_rows
from tableverse_factory.delivery.episodes.pictures import check_pictures
from tableverse_factory.delivery.episodes.render_workers import RenderSetting, render_episodes
from tableverse_factory.delivery.episodes.robot import load_recorded_arm
from tableverse_factory.delivery.episodes.selection import (
    Episode,
    check_new_path,
    get_kind,
    open_episode,
    select_rows,
)
from tableverse_factory.delivery.episodes.video import import_av

_SCENE_COLUMNS = ("scene_id", "split", "licence")


@dataclass(frozen=True, slots=True)
class LeRobotOptions:
    """Export options."""

    failed: bool = False  # include failed trajectories
    width: int = 320  # [px], even
    height: int = 240  # [px], even
    fps: int | None = None  # None for all recorded frames
    pictures: tuple[str, ...] = ("front", "wrist")  # names of `pictures.PICTURES`
    jobs: int = 1  # rendering processes
    robot: str | None = None  # arm of recordings whose robot is not built in: a file, or `menagerie:NAME`


@dataclass(frozen=True, slots=True)
class LeRobotResult:
    """Summary of an export."""

    episodes: int
    frames: int
    pictures: tuple[str, ...]


def export_lerobot(
    dataset: Dataset, dest: Path, options: LeRobotOptions, progress: Callable[[int, int], None] | None = None
) -> LeRobotResult:
    """Write the trajectories of a dataset to a new folder, which appears when it is complete.

    The same dataset and options give the same bytes for any number of processes. `progress` is called with the number
    of episodes written and of all.
    """
    import_av()
    check_new_path(dest)
    scenes = {row["scene_id"]: row for row in dataset.scenes.to_table(columns=list(_SCENE_COLUMNS)).to_pylist()}
    rows = _sort_by_split(select_rows(dataset, options.failed), scenes)
    first = open_episode(dataset, rows[0])
    setting, arm = _build_setting(dataset, first, options), load_recorded_arm(first.recording, options.robot)
    dest = dest.absolute()
    dest.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{dest.name}-", dir=dest.parent) as scratch:
        files = LeRobotFiles(Path(scratch) / "dataset", setting, list_features(arm, setting.object_rows))
        with closing(files):
            for row, shot in zip(rows, render_episodes(dataset.path, setting, rows, options.jobs), strict=True):
                files.add(read_instruction(row), shot, _build_origin(row, scenes[row["scene_id"]]))
                if progress is not None:
                    progress(files.n_episodes, len(rows))
            files.finish().rename(dest)
    return LeRobotResult(files.n_episodes, files.n_frames, setting.pictures)


def _build_setting(dataset: Dataset, first: Episode, options: LeRobotOptions) -> RenderSetting:
    """Build the setting shared by all episodes."""
    if options.width % 2 or options.height % 2:
        raise InputError(f"{options.width} × {options.height}: the sides of a video are even", "bad_size")
    every, fps = compute_stride(first.recording, options.fps)
    size, rows = (options.width, options.height), count_object_rows(dataset)
    return RenderSetting(get_kind(first), check_pictures(options.pictures), *size, every, fps, rows, options.robot)


def _sort_by_split(rows: Sequence[dict[str, Any]], scenes: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Sort rows by split, as LeRobot's splits are ranges of episodes; within a split the order stays."""
    return sorted(rows, key=lambda row: list(SPLITS).index(get_split(scenes[row["scene_id"]])))


def _build_origin(row: Mapping[str, Any], scene: Mapping[str, Any]) -> dict[str, Any]:
    """Build columns of meta/episodes beyond LeRobot's: split, words, origin and outcome of an episode."""
    return {
        "split": get_split(scene),
        "paraphrases": list(paraphrase_instruction(read_instruction(row))),
        "scene_id": row["scene_id"],
        "task_id": row["task_id"],
        "relation": row["relation"] or "",
        "success": bool(row["success"]),
        "failed_phase": row["failed_phase"] or "",
        "reason": row["reason"] or "",
        "licence": scene["licence"] or "",
    }
