"""Parts of a stream's items: decoders by name."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from schemas.config import ObserveConfig
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.storage.untrusted import decode_image, open_image, parse_finite
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.dataset.scene_meta import read_object_names

_BOUNDS = ObserveConfig()
_RECORDED = ("command", "phase", "qpos", "qvel", "tcp", "object_pose")


def _load_masks(scene: Scene) -> np.ndarray | None:
    pixels = _load_picture(scene, "observation/masks.png", None)
    return None if pixels is None else pixels.astype(np.int32)


def _load_picture(scene: Scene, name: str, mode: str | None) -> np.ndarray | None:
    data = scene.files().get(name)
    if data is None:
        return None
    called = f"scene {scene.scene_id}: {name}"
    return decode_image(open_image(data, called, _BOUNDS, "bad_picture"), called, mode, "bad_picture")


def _list_poses(scene: Scene) -> np.ndarray:
    rows = [_read_settled_pose(scene, item) for item in scene.meta["objects"]]
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


def _list_names(scene: Scene) -> list[str]:
    meta = scene.meta
    names = read_object_names(meta)
    return [names[str(item["object_id"])] for item in meta["objects"]]


def _read_settled_pose(scene: Scene, item: Mapping[str, Any]) -> list[float]:
    try:
        pose = item["poses"]["settled"]
        numbers = [parse_finite(value) for value in (*pose["position"], *pose["quaternion_wxyz"])]
    except (KeyError, TypeError):
        numbers = []
    if len(numbers) != 7 or None in numbers:
        called = sanitize_line(str(item["object_id"]), 60)
        raise InputError(f"scene {scene.scene_id}: meta.json has no settled pose of {called}", "bad_meta")
    return [number for number in numbers if number is not None]


def _list_motions(scene: Scene) -> list[dict[str, Any]]:
    """List executed motions: task, success, commands and recorded states."""
    found = []
    for trajectory in scene.trajectories():
        if trajectory.row["arrays"] is not None:
            its = trajectory.recording()
            arrays = {name: getattr(its, name).copy() for name in _RECORDED}  # torch wants them writable
            told = {name: trajectory.row[name] for name in ("task_id", "instruction", "x_id", "y_id", "relation")}
            found.append({**told, "success": trajectory.success, "step_s": its.step_s, **arrays})
    return found


PARTS: Mapping[str, Callable[[Scene], Any]] = {
    "photograph": lambda scene: _load_picture(scene, "observation/color.jpg", "RGB"),  # (h, w, 3) uint8, sRGB
    "masks": _load_masks,  # instance ids, 0 = background, (h, w) int32
    "ids": lambda scene: [str(item["object_id"]) for item in scene.meta["objects"]],  # in the order of `poses`
    "labels": _list_names,  # the judge's, else the detector's, in the order of `poses`
    "poses": _list_poses,  # settled, in the table frame: position [m] and quaternion wxyz, (n, 7) float64
    "meta": lambda scene: scene.meta,
    "xml": lambda scene: scene.xml,
    "files": lambda scene: scene.files(),
    "motions": _list_motions,
}
"""Parts by name. `photograph` and `masks` are None where a scene was not made from a picture."""


def check_parts(names: tuple[str, ...]) -> tuple[str, ...]:
    """Check that these are names of parts, and return them."""
    for name in names:
        if name not in PARTS:
            raise ConfigError(f"no part {sanitize_line(str(name), 60)!r} of a scene; there are {', '.join(PARTS)}")
    return names
