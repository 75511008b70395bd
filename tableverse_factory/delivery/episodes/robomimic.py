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
from pathlib import Path
from typing import Any

import numpy as np

from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.dataset.splits import get_split
from tableverse_factory.delivery.episodes.demonstration import Demonstration, build_demonstration, build_env_args
from tableverse_factory.delivery.episodes.instructions import paraphrase_instruction, read_instruction
from tableverse_factory.delivery.episodes.observation import count_object_rows
from tableverse_factory.delivery.episodes.robot import load_recorded_arm
from tableverse_factory.delivery.episodes.selection import (
    check_kind,
    check_new_path,
    get_kind,
    open_episodes,
    select_rows,
)

_MASKS = {"train": "train", "validation": "valid", "test": "test"}  # robomimic's names of splits


@dataclass(frozen=True, slots=True)
class RobomimicResult:
    """Summary of an export."""

    demos: int
    samples: int


def export_robomimic(dataset: Dataset, dest: Path, failed: bool = False, robot: str | None = None) -> RobomimicResult:
    """Write the trajectories of a dataset to a new file, which appears when it is complete. Same input, same bytes.

    `robot` is the arm of recordings whose robot is not built in: a file, or `menagerie:NAME`.
    """
    h5py = import_extra("h5py", "HDF5", "episodes")
    check_new_path(dest)
    rows = select_rows(dataset, failed)
    dest = dest.absolute()
    dest.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{dest.name}-", dir=dest.parent) as scratch:
        partial, total, first, object_rows = Path(scratch) / "demos.hdf5", 0, None, count_object_rows(dataset)
        masks: dict[str, list[str]] = {}
        with h5py.File(partial, "w") as file:
            data = file.create_group("data")
            for number, episode in enumerate(open_episodes(dataset, rows)):
                first = first or get_kind(episode)
                check_kind(first, episode)
                arm = load_recorded_arm(episode.recording, robot)
                demo = build_demonstration(episode, arm, object_rows)
                _write_demo(data.create_group(f"demo_{number}"), demo, episode.row)
                _write_assets(file, episode.scene.scene_id, demo.assets)
                for mask in (
                    _MASKS[get_split(episode.scene.row)],
                    "success" if episode.row["success"] else "failed",
                ):
                    masks.setdefault(mask, []).append(f"demo_{number}")
                total += len(demo.actions)
                data.attrs["env_args"] = json.dumps(build_env_args(episode.recording, arm, object_rows))
            data.attrs["total"] = total
            for mask, names in sorted(masks.items()):
                _write_array(file.require_group("mask"), mask, np.array(names, dtype="S"))
        partial.rename(dest)
    return RobomimicResult(len(rows), total)


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
