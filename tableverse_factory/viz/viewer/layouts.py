"""Where the objects of a scene were at each step of the pipeline: as seen, as rectified, as settled."""

from collections.abc import Mapping
from typing import Any

from schemas.geometry import Pose
from tableverse_factory.dataset.meta_poses import pose_in_meta

SETTLED, RECTIFIED, OBSERVED = "settled", "rectified", "observed"
LAYOUTS = (OBSERVED, RECTIFIED, SETTLED)
"""In the order of the pipeline."""

_KEYS = {OBSERVED: "placed", RECTIFIED: "rectified"}

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
                poses[name] = pose_in_meta(value, name)
        if poses:
            found[layout] = poses
    return {**found, SETTLED: dict(settled)}
