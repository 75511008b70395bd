"""Depth that was made elsewhere, by any model or sensor, and lies beside the picture: the door for everything else."""

import io
from typing import Any

import numpy as np

from schemas.config import Config, ObserveConfig
from schemas.geometry import Camera, DepthImage
from schemas.manifest import ImageRow
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import redact_uri
from tableverse_factory.core.storage.untrusted import finite_number, parse_json, read_bytes
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.sources.capture import MAX_CAMERA_BYTES, MAX_FOCAL_PX, Capture
from tableverse_factory.sources.content_hash import CAMERA_SUFFIX, DEPTH_SUFFIX, sidecar_files
from tableverse_factory.stages.observe.depth.estimate import MODEL_BEND, DepthEstimate, camera_for, capture_of
from tableverse_factory.stages.observe.depth.rgb_image import read_photograph

MAX_BEND = 0.1
MAX_ASPECT_CHANGE = 0.02
_MAX_SIDE = 100_000


def recorded(item: ImageRow, config: Config) -> Capture:
    """The picture with the depth in `NAME.depth.npy` and the camera in `NAME.camera.json`, for a picture `NAME.jpg`.

    Raises:
        InputError: `no_recorded_depth`, `unreadable_depth`, `depth_size_differs`, `depth_all_zero`, `bad_intrinsics`,
            or as `read_photograph`.
    """
    photo = read_photograph(item.uri, config.observe)
    there = sidecar_files(item.uri)
    missing = [suffix for suffix in (DEPTH_SUFFIX, CAMERA_SUFFIX) if suffix not in there]
    if missing:
        stem = _name(item.uri).rpartition(".")[0]
        lacking = " and ".join(stem + suffix for suffix in missing)
        raise InputError(
            f"observe.depth is 'recorded', and beside the picture there is no {lacking}", "no_recorded_depth"
        )
    depth = read_array(there[DEPTH_SUFFIX], config.observe)
    camera, bend = read_recorded_camera(there[CAMERA_SUFFIX])
    height, width = photo.color.shape[:2]
    _same_aspect("the depth", depth.shape[1], depth.shape[0], width, height)
    _same_aspect("the camera", camera.width, camera.height, width, height)
    at_depth = camera_for(camera, depth.shape[1], depth.shape[0])
    return capture_of(photo.color, DepthEstimate(depth, at_depth, bend), config.observe, _name(there[DEPTH_SUFFIX]))


def read_array(uri: str, bounds: ObserveConfig) -> DepthImage:
    """Metres of a `.npy` file. Shape (h, w) float32.

    Raises:
        InputError: `unreadable_depth`, `picture_too_large`, `file_too_large`.
    """
    name, data = _name(uri), read_bytes(uri, bounds.max_file_bytes, "unreadable_depth")
    try:
        values = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, OSError, EOFError, SyntaxError, TypeError, MemoryError, OverflowError) as error:
        raise InputError(f"{name} is no array of numbers: {type(error).__name__}", "unreadable_depth") from error
    if not isinstance(values, np.ndarray) or values.ndim != 2 or values.dtype.kind != "f" or values.size == 0:
        raise InputError(
            f"{name}: give metres as floats, one for each pixel, shape (height, width)", "unreadable_depth"
        )
    if values.size > bounds.max_pixels:
        raise InputError(
            f"{name} has {values.size} pixels; at most {bounds.max_pixels} (observe.max_pixels) are read",
            "picture_too_large",
        )
    return values.astype(np.float32)


def read_recorded_camera(uri: str) -> tuple[Camera, float]:
    """Intrinsics, for the size that they name, and how far the depth may be bent.

    Raises:
        InputError: `bad_intrinsics`.
    """
    name = _name(uri)
    value = parse_json(read_bytes(uri, MAX_CAMERA_BYTES, "bad_intrinsics"), name, "bad_intrinsics")
    if not isinstance(value, dict):
        raise InputError(f"{name} holds no object of names and numbers", "bad_intrinsics")
    width, height = (round(_number(name, value, key, 1, _MAX_SIDE)) for key in ("width", "height"))
    fx, fy = (_number(name, value, key, 1e-3, MAX_FOCAL_PX) for key in ("fx", "fy"))
    cx, cy = _number(name, value, "cx", -0.5, width - 0.5), _number(name, value, "cy", -0.5, height - 0.5)
    bend = _number(name, value, "bend", 0.0, MAX_BEND) if "bend" in value else MODEL_BEND
    return Camera(fx, fy, cx, cy, width, height), bend


def _name(uri: str) -> str:
    """A file's own name as it may stand in a message."""
    return sanitize_line(redact_uri(uri).rpartition("/")[2], 100)


def _number(name: str, value: dict[str, Any], key: str, low: float, high: float) -> float:
    number = finite_number(value.get(key))
    if number is None or not low <= number <= high:
        said = str(value.get(key))[:80]
        raise InputError(f"{name}: {key} is {said!r}; give a finite number from {low:g} to {high:g}", "bad_intrinsics")
    return number


def _same_aspect(what: str, width: int, height: int, picture_width: int, picture_height: int) -> None:
    if abs(width * picture_height / (height * picture_width) - 1.0) > MAX_ASPECT_CHANGE + 1.0 / min(width, height):
        raise InputError(
            f"{what} is for {width} x {height} pixels, the picture {picture_width} x {picture_height} upright: it is "
            "of another picture, or of this one turned",
            "depth_size_differs",
        )
