"""`meta.json` as other rooms read it, without importing physics."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.geometry import Camera, Pose
from schemas.identity import UNNAMED
from schemas.scene import Certificate
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.preview_image import TALLEST
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.geometry.math.transforms import normalize_quaternion
from tableverse_factory.physics.mjcf.pose_history import PoseHistory

FORMAT = "tableverse-scene-1"
FARTHEST_M = 1e3
_LONGEST_NAME = 200


@dataclass(frozen=True, slots=True)
class SceneMeta:
    """Content of a `meta.json` that verification needs."""

    certificate: Certificate
    history: PoseHistory
    files: Mapping[str, Mapping[str, Any]]


def read_meta(data: bytes) -> SceneMeta:
    """Read the stored certificate, and the poses before settling."""
    from tableverse_factory.core.storage.untrusted import parse_json  # imports Pillow, which queries need not load

    content = parse_json(data, "meta.json", "bad_meta")
    try:
        if content["format"] != FORMAT:
            raise InputError(f"meta.json: format {content['format']!r:.60}; this version reads {FORMAT!r}", "bad_meta")
        stored = content["certificate"]
        pairs = tuple((str(name), float(value)) for name, value in stored["displacement_m"])
        names = {key: tuple(map(str, stored[key])) for key in ("fell", "left_container")}
        objects = {str(item["object_id"]): item for item in content["objects"]}
        placed = {name: item["poses"]["placed"] for name, item in objects.items()}
        holders = {name: item.get("placed_in", item["contained_in"]) for name, item in objects.items()}
        return SceneMeta(
            Certificate(**{**stored, "displacement_m": pairs, **names}),
            PoseHistory(
                placed={name: _parse_pose(pose) for name, pose in placed.items() if pose is not None},
                rectified={name: _parse_pose(item["poses"]["rectified"]) for name, item in objects.items()},
                contained_in={name: holder for name, holder in holders.items() if holder is not None},
            ),
            dict(content["files"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"meta.json is not of a scene: {type(error).__name__}: {error}"[:300], "bad_meta") from error


def read_object_names(meta: Mapping[str, Any]) -> dict[str, str]:
    """Read the name of every object by id: the judge's `relabel_name`, else the detector's label; printable."""
    verdicts = _read_verdicts(meta)
    ids = {str(item["object_id"]): item for item in meta.get("objects", ())}
    names = {key: verdicts.get(key, {}).get("relabel_name") or item.get("label") for key, item in ids.items()}
    return {key: sanitize_line(str(name or ""), _LONGEST_NAME) for key, name in names.items()}


def read_object_phrases(meta: Mapping[str, Any]) -> dict[str, str]:
    """Read a phrase of every object by id: its first distinguishing phrase, else its name after *the*; printable."""
    verdicts = _read_verdicts(meta)
    phrases = {key: f"the {name or UNNAMED}" for key, name in read_object_names(meta).items()}
    for key in phrases:
        given = verdicts.get(key, {}).get("distinguishing_phrases")
        if isinstance(given, list) and given:
            phrases[key] = sanitize_line(str(given[0]), _LONGEST_NAME)
    return phrases


def _read_verdicts(meta: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Read the judge's verdict on every object by id; none where the scene was not judged."""
    assessment = meta.get("assessment")
    rows = assessment.get("objects") if isinstance(assessment, Mapping) else None
    listed = [row for row in rows if isinstance(row, Mapping)] if isinstance(rows, list) else []
    return {str(row.get("object_id")): row for row in listed}


def read_meta_camera(meta: Mapping[str, Any]) -> PosedCamera | None:
    """Read the camera of the photograph; None if there is no photograph."""
    camera, pose = meta.get("camera"), meta.get("camera_to_table")
    if camera is None or pose is None:
        return None
    try:
        fx, fy, cx, cy = (float(camera[key]) for key in ("fx", "fy", "cx", "cy"))
        width, height = int(camera["width"]), int(camera["height"])
        if not (0 < width <= 100_000 and 0 < height <= 100_000 and height <= TALLEST * width):
            raise ValueError(f"{width} × {height} pixels")
        if not (np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy) > 0.0):
            raise ValueError(f"focal lengths {fx:g}, {fy:g} px, centre {cx:g}, {cy:g}")
        return PosedCamera(Camera(fx, fy, cx, cy, width, height), read_meta_pose(pose, "the camera"))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        problem = f"meta.json: invalid camera: {json.dumps(camera)[:200]}: {error}"[:400]
        raise InputError(problem, "bad_meta") from error


def read_meta_pose(value: Any, owner: str) -> Pose:
    """Read `{"position": [x, y, z], "quaternion_wxyz": [w, x, y, z]}`, at most `FARTHEST_M` away [m]."""
    try:
        return _parse_pose(value, FARTHEST_M)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        problem = f"{sanitize_line(owner, 60)} makes no sense: {sanitize_line(str(error), 120)}"
        raise InputError(f"meta.json: a pose of {problem}", "bad_meta") from None


def _parse_pose(value: Mapping[str, Any], farthest_m: float = math.inf) -> Pose:
    position, quaternion = (np.array(value[key], dtype=np.float64) for key in ("position", "quaternion_wxyz"))
    if position.shape != (3,) or quaternion.shape != (4,) or not np.abs(position).max() < farthest_m:
        raise ValueError("numbers that make no pose")
    return Pose(position, normalize_quaternion(quaternion))
