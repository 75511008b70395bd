"""Poses of the objects of a scene after each step of the pipeline: observed, rectified, settled."""

from collections.abc import Mapping
from typing import Any

from schemas.geometry import Pose
from tableverse_factory.dataset.scene_meta import read_meta_pose

SETTLED, RECTIFIED, OBSERVED = "settled", "rectified", "observed"
LAYOUTS = (OBSERVED, RECTIFIED, SETTLED)  # in the order of the pipeline

_KEYS = {OBSERVED: "placed", RECTIFIED: "rectified"}

Poses = Mapping[str, Pose]


def read_layouts(meta: Mapping[str, Any], settled: Poses) -> dict[str, Poses]:
    """Read the layouts of a scene; the settled one, of the exported model, always exists.

    Copies added by `count` (`copy_of`) are in no observed layout; scenes of other origin have no poses in `meta.json`.
    """
    found: dict[str, Poses] = {}
    for layout, key in _KEYS.items():
        poses = {}
        for item in meta.get("objects", []):
            known = item.get("poses")
            value = known.get(key) if isinstance(known, Mapping) else None
            name = str(item["object_id"])
            if value is not None and name in settled:
                poses[name] = read_meta_pose(value, name)
        if poses:
            found[layout] = poses
    return {**found, SETTLED: dict(settled)}
