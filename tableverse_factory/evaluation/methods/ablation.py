"""The paper's ablation (table 2) of our datasets: the same meshes at placed, rectified and exported poses."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import MAX_JSON_BYTES, parse_json, read_bytes
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.evaluation.methods.scenes import MethodObject, MethodScene, SceneSource
from tableverse_factory.evaluation.methods.sources import find_exported, read_model_scene, read_pose

CONFIGURATIONS = {"Direct": "placed", "Direct + LCCR": "rectified", "Direct + LCCR + Simulation": "settled"}
"""Rows of the paper's table, and the names of their poses in `meta.json`."""


def list_configurations(folder: Path) -> dict[str, str]:
    """Return `CONFIGURATIONS` with the rectification method of this dataset's run.json instead of LCCR."""
    value: Any = parse_json(read_bytes(str(folder / "run.json"), MAX_JSON_BYTES, "bad_run"), "run.json", "bad_run")
    for key in ("config", "rectify", "method"):
        value = value.get(key) if isinstance(value, dict) else None
    method = str(value or "lccr")
    name = "LCCR" if method == "lccr" else sanitize_line(method, 40)
    return {row.replace("LCCR", name): poses for row, poses in CONFIGURATIONS.items()}


def find_ablation_scenes(folder: Path, poses: str) -> list[SceneSource]:
    """Find the exported scenes of a dataset with the poses of one configuration.

    Dropped scenes are missing, so the figures before settling are those of the survivors; `tableverse bench lccr`
    measures all layouts of a folder.
    """
    return find_exported(folder, partial(_read_scene, poses))


def _read_scene(poses: str, dataset: Dataset, scene_id: str) -> MethodScene:
    exported = dataset.scene(scene_id)
    scene, entries = read_model_scene(exported.model()), exported.meta.get("objects", [])
    known = {str(entry["object_id"]): entry.get("poses") for entry in entries}
    moved = (_move_object(scene_id, item, known, poses) for item in scene.objects)
    return replace(scene, objects=tuple(item for item in moved if item is not None))


def _move_object(scene_id: str, item: MethodObject, known: Mapping[str, Any], poses: str) -> MethodObject | None:
    """Return the object at a pose; None if it had none yet: copies are made after placing."""
    try:
        pose = known[item.name][poses]
    except (KeyError, TypeError):
        raise InputError(f"{scene_id}: meta.json has no {poses} pose of {item.name}", "bad_meta") from None
    return None if pose is None else replace(item, pose=read_pose(pose))
