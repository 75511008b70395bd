"""Client for a GraspGen or GraspGenX server, over a small JSON protocol.

The request is a POST of JSON to `<grasp_url>/grasps`:

    {"format": "tableverse-grasps-1", "gripper": "franka_panda", "count": 256, "points": [[x, y, z], ...]}

`points` [m] lie evenly on the surface, their centroid at the origin (paper, appendix D). The answer:

    {"grasps": [[[r, r, r, x], [r, r, r, y], [r, r, r, z], [0, 0, 0, 1]], ...], "scores": [s, ...]}

with the gripper's base in the frame of the points, by GraspGen's published convention: z approach, x closing axis.
"""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64

from schemas.config import TrajectoriesConfig
from schemas.geometry import Points, TriangleMesh
from schemas.trajectories import Grasps
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.geometry.relations.antipodal import sample_inward_normals
from tableverse_factory.models.remote.answers import AnswerCache, compute_answer_key
from tableverse_factory.models.remote.endpoint import Endpoint
from tableverse_factory.models.remote.exchange import ChatCompletion, Message, Usage
from tableverse_factory.models.remote.http import post_json
from tableverse_factory.models.services import Services

FORMAT = "tableverse-grasps-1"
POINTS = 2048
COUNT, MAX_COUNT = 256, 4096  # numbers of grasps requested, and accepted at most
MAX_DISTANCE_M = 2.0  # maximum distance of a gripper's base from the centroid
# Rotations within this of orthonormal, in every entry of `R'R - 1`, are orthonormalized; others are refused
ROTATION_TOLERANCE = 1e-2
# Our gripper frame (y closing, z approach) in theirs (x closing, z approach)
_GRIPPER_AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def request_grasps(mesh: TriangleMesh, config: TrajectoriesConfig, services: Services) -> Grasps:
    """Request grasps of a body, table frame, with widths 0; valid answers are cached on disk by request."""
    points, _ = sample_inward_normals(mesh, POINTS)
    centroid = points.mean(axis=0)
    question = {
        "format": FORMAT,
        "gripper": config.grasp_gripper,
        "count": COUNT,
        "points": np.round(points - centroid, 6).tolist(),
    }
    poses, scores = _check_answer(_fetch_answer(question, config, services))
    rotations = poses[:, :3, :3] @ _GRIPPER_AXES
    positions: Points = poses[:, :3, 3] + centroid + config.grasp_depth_m * rotations[:, :, 2]
    return Grasps(rotations, positions, np.zeros(len(scores)), scores)


def _fetch_answer(question: Mapping[str, Any], config: TrajectoriesConfig, services: Services) -> Mapping[str, Any]:
    endpoint = Endpoint("grasps", config.grasp_url, config.grasp_gripper, timeout_s=config.grasp_timeout_s)
    cache = AnswerCache(services.cache_dir)
    key = compute_answer_key(endpoint, (Message("user", json.dumps(question)),), {})
    kept = cache.get(key)
    if kept is not None:
        return json.loads(kept.text)
    cache.check()
    body = post_json(endpoint, "grasps", question)
    _check_answer(body)
    cache.put(key, ChatCompletion(json.dumps({name: body[name] for name in ("grasps", "scores")}), Usage()))
    return body


def _check_answer(body: Mapping[str, Any]) -> tuple[Float64[np.ndarray, "n 4 4"], Float64[np.ndarray, " n"]]:
    """Return grasps, with orthonormal rotations, and scores of an untrusted answer."""
    poses, scores = _read_numbers(body, "grasps"), _read_numbers(body, "scores")
    if not poses.size:
        poses = poses.reshape(0, 4, 4)
    if scores.ndim != 1 or poses.shape != (len(scores), 4, 4):
        raise _invalid(f"grasps of shape {poses.shape} and scores of shape {scores.shape}; give (n, 4, 4) and (n,)")
    if len(scores) > MAX_COUNT:
        raise _invalid(f"{len(scores)} grasps; at most {MAX_COUNT} are taken")
    if np.abs(poses[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(initial=0.0) > ROTATION_TOLERANCE:
        raise _invalid("a matrix whose last row is not 0 0 0 1: give them row by row, translations in the last column")
    if (farthest := np.abs(poses[:, :3, 3]).max(initial=0.0)) > MAX_DISTANCE_M:
        raise _invalid(f"a gripper {farthest:.3g} m from the points; give metres, at most {MAX_DISTANCE_M:g}")
    rotations = poses[:, :3, :3]
    error = np.abs(np.einsum("nji,njk->nik", rotations, rotations) - np.eye(3)).max(axis=(1, 2), initial=0.0)
    wrong = np.flatnonzero((error > ROTATION_TOLERANCE) | (np.linalg.det(rotations) <= 0.0))
    if len(wrong):
        raise _invalid(f"{len(wrong)} matrices whose rotation is none, the first is number {wrong[0]}")
    left, _, right = np.linalg.svd(rotations)
    poses[:, :3, :3] = left @ right
    return poses, scores


def _read_numbers(body: Mapping[str, Any], name: str) -> np.ndarray:
    if name not in body:
        raise _invalid(f"no {name!r}")
    try:
        values = np.array(body[name])
    except (ValueError, OverflowError) as error:
        raise _invalid(f"{name!r} is ragged, or a number in it is too large") from error
    if values.size and values.dtype.kind not in "if":
        raise _invalid(f"{name!r} holds what is no number")
    values = values.astype(np.float64)
    if not np.isfinite(values).all():
        raise _invalid(f"{name!r} holds NaN or infinity")
    return values


def _invalid(what: str) -> AnswerInvalidError:
    return AnswerInvalidError(f"the grasp server answers {what}", "grasps_invalid")
