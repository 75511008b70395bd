"""Where the objects of a scene were at each step of the pipeline: as seen, as rectified, as settled."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from schemas.geometry import Pose
from tableverse_factory.errors import InputError
from tableverse_factory.geometry.transforms import normalized_quaternion
from tableverse_factory.text import printable

SETTLED, RECTIFIED, OBSERVED = "settled", "rectified", "observed"
LAYOUTS = (OBSERVED, RECTIFIED, SETTLED)
"""In the order of the pipeline."""

_KEYS = {OBSERVED: "placed", RECTIFIED: "rectified"}
_FARTHEST_M = 1e3

Poses = Mapping[str, Pose]


def layouts_of(meta: Mapping[str, Any], settled: Poses) -> dict[str, Poses]:
    """The layouts that a scene has, the settled one always.

    An object that was counted and not seen by itself (`copy_of`) is in no observed layout.

    Args:
        meta: `meta.json`; a scene of other origin has no poses in it.
        settled: Of the objects, as the exported model has them.

    Raises:
        InputError: `bad_meta` for a pose that is none.
    """
    found: dict[str, Poses] = {}
    for layout, key in _KEYS.items():
        poses = {}
        for item in meta.get("objects", []):
            known = item.get("poses")
            value = known.get(key) if isinstance(known, Mapping) else None
            name = str(item["object_id"])
            if value is not None and name in settled:
                poses[name] = _pose(value, name)
        if poses:
            found[layout] = poses
    return {**found, SETTLED: dict(settled)}


def _pose(value: Any, name: str) -> Pose:
    try:
        position, quaternion = (np.array(value[key], dtype=np.float64) for key in ("position", "quaternion_wxyz"))
        if position.shape != (3,) or quaternion.shape != (4,) or not np.abs(position).max() < _FARTHEST_M:
            raise ValueError("numbers that make no pose")
        return Pose(position, normalized_quaternion(quaternion))
    except (KeyError, TypeError, ValueError) as error:
        said = printable(str(error), 120)
        raise InputError(f"meta.json: a pose of {printable(name, 60)} makes no sense: {said}", "bad_meta") from None
