"""Messages between the benchmark and a policy in another process: JSON, with arrays as base64 of their bytes."""

import base64
import binascii
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from schemas.curation import Relation
from schemas.geometry import Pose
from tableverse_factory.evaluation.benchmark.policy import EpisodeStart

TYPES = ("float32", "float64", "uint8")
MAX_DIMENSIONS = 4
MAX_MESSAGE_BYTES = 256 * 1024 * 1024


def encode_array(array: np.ndarray) -> dict[str, Any]:
    """Encode an array: its type, its shape and its little-endian bytes, row by row, as base64."""
    if array.dtype.name not in TYPES:
        raise ValueError(f"arrays of {array.dtype.name} are not sent; give one of {', '.join(TYPES)}")
    data = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
    return {"type": array.dtype.name, "shape": list(array.shape), "base64": base64.b64encode(data).decode()}


def decode_array(value: Any) -> np.ndarray:
    """Decode an array of any origin; ValueError if it is none."""
    if not isinstance(value, Mapping) or value.keys() != {"type", "shape", "base64"} or value["type"] not in TYPES:
        raise ValueError("no array: give type, shape and base64")
    shape, text = value["shape"], value["base64"]
    if not isinstance(shape, list) or len(shape) > MAX_DIMENSIONS or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"an array of shape {shape!r:.60}")
    try:
        data = base64.b64decode(text, validate=True)
    except (binascii.Error, TypeError, ValueError):
        raise ValueError("an array that is no base64") from None
    kind = np.dtype(value["type"]).newbyteorder("<")
    if math.prod(shape) * kind.itemsize != len(data):
        raise ValueError(f"an array of shape {shape} with {len(data)} bytes")
    return np.frombuffer(data, dtype=kind).reshape(shape).astype(value["type"])


def encode_start(start: EpisodeStart) -> dict[str, Any]:
    """Encode what a policy is told of an episode, without the environment."""
    return {
        "episode_id": start.episode_id,
        "seed": start.seed,
        "instruction": start.instruction,
        "relation": start.relation.value,
        "points": encode_array(start.points),
        "robot": start.robot,
        "base": [*start.base.position.tolist(), *start.base.quaternion_wxyz.tolist()],
        "lower": start.lower.tolist(),
        "upper": start.upper.tolist(),
        "step_s": start.step_s,
        "limit_steps": start.limit_steps,
    }


def decode_start(value: Mapping[str, Any]) -> EpisodeStart:
    """Decode `encode_start`; KeyError, TypeError or ValueError for anything else."""
    base = np.array(value["base"], dtype=np.float64)
    if base.shape != (7,):
        raise ValueError("base: give position and quaternion wxyz")
    return EpisodeStart(
        episode_id=str(value["episode_id"]),
        seed=int(value["seed"]),
        instruction=str(value["instruction"]),
        relation=Relation(value["relation"]),
        points=decode_array(value["points"]),
        robot=str(value["robot"]),
        base=Pose(base[:3], base[3:]),
        lower=np.array(value["lower"], dtype=np.float64),
        upper=np.array(value["upper"], dtype=np.float64),
        step_s=float(value["step_s"]),
        limit_steps=int(value["limit_steps"]),
    )
