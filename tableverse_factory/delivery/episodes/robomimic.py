"""Demonstrations in one robomimic HDF5 file, with everything needed to restore them in MuJoCo.

    data                attributes: total, env_args (JSON)
    data/demo_0         attributes: num_samples, model_file (MJCF), ep_meta (JSON: lang, scene, task, success)
        actions (n, j + 1)   rewards (n,)   dones (n,)   states (n, 1 + nq + nv)   obs/…   next_obs/…
        phase (n,)
    mask/train, valid, test, success, failed    names of demonstrations; each exists if it has any
    assets/SCENE_ID/…   files that model_file references

The layout is that of robomimic's public documentation, which does not know `assets`.
"""

import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.dataset.splits import get_split
from tableverse_factory.delivery.episodes.demonstration import (
    Demonstration,
    DemonstrationSetting,
    build_demonstration,
    build_env_args,
)
from tableverse_factory.delivery.episodes.instructions import paraphrase_instruction, read_instruction
from tableverse_factory.delivery.episodes.observation import count_object_rows
from tableverse_factory.delivery.episodes.pictures import check_pictures
from tableverse_factory.delivery.episodes.robot import load_recorded_arm
from tableverse_factory.delivery.episodes.selection import (
    EpisodeKind,
    check_kind,
    check_new_path,
    get_kind,
    open_episode,
    select_rows,
)

_MASKS = {"train": "train", "validation": "valid", "test": "test"}  # robomimic's names of splits


@dataclass(frozen=True, slots=True)
class RobomimicOptions:
    """Export options."""

    failed: bool = False  # include failed trajectories
    pictures: tuple[str, ...] = ()  # names of `pictures.PICTURES`, drawn for every sample
    width: int = 128  # [px]
    height: int = 96  # [px]
    jobs: int = 1  # processes
    robot: str | None = None  # arm of recordings whose robot is not built in: a file, or `menagerie:NAME`


@dataclass(frozen=True, slots=True)
class RobomimicResult:
    """Summary of an export."""

    demos: int
    samples: int


@dataclass(frozen=True, slots=True)
class _Built:
    """Demonstration with what the file says about it."""

    demo: Demonstration
    split: str
    env_args: dict[str, Any]


def export_robomimic(dataset: Dataset, dest: Path, options: RobomimicOptions) -> RobomimicResult:
    """Write the trajectories of a dataset to a new file, which appears when it is complete.

    The same dataset and options give the same bytes for any number of processes.
    """
    h5py = import_extra("h5py", "HDF5", "episodes")
    check_new_path(dest)
    rows = select_rows(dataset, options.failed)
    size = (options.height, options.width)
    setting = DemonstrationSetting(count_object_rows(dataset), check_pictures(options.pictures), size)
    build = partial(_build, dataset.path, get_kind(open_episode(dataset, rows[0])), setting, options.robot)
    dest = dest.absolute()
    dest.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{dest.name}-", dir=dest.parent) as scratch:
        partial_file, total = Path(scratch) / "demos.hdf5", 0
        masks: dict[str, list[str]] = {}
        with h5py.File(partial_file, "w") as file:
            data = file.create_group("data")
            built = parallel_map(build, rows, options.jobs, "builds demonstrations")
            for number, (row, its) in enumerate(zip(rows, built, strict=True)):
                _write_demo(data.create_group(f"demo_{number}"), its.demo, row)
                _write_assets(file, str(row["scene_id"]), its.demo.assets)
                for mask in (_MASKS[its.split], "success" if row["success"] else "failed"):
                    masks.setdefault(mask, []).append(f"demo_{number}")
                total += len(its.demo.actions)
                data.attrs["env_args"] = json.dumps(its.env_args)
            data.attrs["total"] = total
            for mask, names in sorted(masks.items()):
                _write_array(file.require_group("mask"), mask, np.array(names, dtype="S"))
        partial_file.rename(dest)
    return RobomimicResult(len(rows), total)


def _build(
    path: str, kind: EpisodeKind, setting: DemonstrationSetting, robot: str | None, row: Mapping[str, Any]
) -> _Built:
    """Build the demonstration of a row of trajectories/."""
    episode = open_episode(open_dataset(path), row)
    check_kind(kind, episode)
    arm = load_recorded_arm(episode.recording, robot)
    env_args = build_env_args(episode.recording, arm, setting)
    return _Built(build_demonstration(episode, arm, setting), get_split(episode.scene.row), env_args)


def _write_demo(group: Any, demo: Demonstration, row: Mapping[str, Any]) -> None:
    keys = ("scene_id", "task_id", "x_id", "y_id", "relation", "success", "failed_phase", "reason")
    lang = read_instruction(row)
    meta = {"lang": lang, "paraphrases": paraphrase_instruction(lang), **{key: row[key] for key in keys}}
    group.attrs["num_samples"] = len(demo.actions)
    group.attrs["model_file"] = demo.model
    group.attrs["ep_meta"] = json.dumps(meta)
    for name in ("actions", "rewards", "dones", "states"):
        _write_array(group, name, getattr(demo, name))
    _write_array(group, "phase", demo.phases)
    following = np.minimum(np.arange(len(demo.actions)) + 1, len(demo.actions) - 1)
    for name, values in demo.observations.items():
        _write_array(group.require_group("obs"), name, values)
        _write_array(group.require_group("next_obs"), name, values[following])


def _write_assets(file: Any, scene_id: str, assets: Mapping[str, bytes]) -> None:
    """Write files by name; slashes in names make HDF5 groups."""
    group = file.require_group(f"assets/{scene_id}")
    for name, data in sorted(assets.items()):
        if name not in group:
            _write_array(group, name, np.frombuffer(data, dtype=np.uint8))


def _write_array(group: Any, name: str, values: np.ndarray) -> None:
    packing = {"compression": "gzip", "compression_opts": 4, "shuffle": True} if values.size > 64 else {}
    group.create_dataset(name, data=values, track_times=False, **packing)
