"""The paper's ablation (table 2) of our own datasets: the same meshes as placed, as rectified, and as exported."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow.compute as pc

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import MAX_JSON_BYTES, parse_json, read_bytes
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.evaluation.methods.scenes import MethodObject, MethodScene, Source
from tableverse_factory.evaluation.methods.sources import read_pose, scene_of_model

CONFIGURATIONS = {"Direct": "placed", "Direct + LCCR": "rectified", "Direct + LCCR + Simulation": "settled"}
"""Rows of the paper's table, and what the poses after that much work are called in `meta.json`."""


def configurations(folder: Path) -> dict[str, str]:
    """`CONFIGURATIONS`, with the name of what rectified this dataset where that is not LCCR.

    Raises:
        InputError: if its run.json cannot be read.
    """
    value: Any = parse_json(read_bytes(str(folder / "run.json"), MAX_JSON_BYTES, "bad_run"), "run.json", "bad_run")
    for key in ("config", "rectify", "method"):
        value = value.get(key) if isinstance(value, dict) else None
    method = str(value or "lccr")
    name = "LCCR" if method == "lccr" else sanitize_line(method, 40)
    return {row.replace("LCCR", name): poses for row, poses in CONFIGURATIONS.items()}


def ablation_sources(folder: Path, poses: str) -> list[Source]:
    """The exported scenes of a dataset with the poses of one configuration.

    Scenes that the factory dropped are not among them, so that the figures before settling are those of the survivors;
    `tableverse bench lccr` measures all of a folder of layouts.

    Raises:
        InputError: if there is no dataset.
    """
    dataset = open_dataset(folder)
    done = dataset.scenes.to_table(filter=pc.field("status") == "done", columns=["scene_id"]).column(0).to_pylist()
    return [Source(scene_id, "dataset", partial(_read, dataset, scene_id, poses)) for scene_id in sorted(done)]


def _read(dataset: Dataset, scene_id: str, poses: str) -> MethodScene:
    exported = dataset.scene(scene_id)
    scene, entries = scene_of_model(exported.model()), exported.meta.get("objects", [])
    known = {str(entry["object_id"]): entry.get("poses") for entry in entries}
    moved = (_moved(scene_id, item, known, poses) for item in scene.objects)
    return replace(scene, objects=tuple(item for item in moved if item is not None))


def _moved(scene_id: str, item: MethodObject, known: Mapping[str, Any], poses: str) -> MethodObject | None:
    """The object at that pose; None if it had none yet: copies of a counted thing are made after placing."""
    try:
        pose = known[item.name][poses]
    except (KeyError, TypeError):
        raise InputError(f"{scene_id}: meta.json has no {poses} pose of {item.name}", "bad_meta") from None
    return None if pose is None else replace(item, pose=read_pose(pose))
