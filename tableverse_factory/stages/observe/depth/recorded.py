"""Depth and camera recorded in files beside the picture, by any other model or sensor."""

import io
import json
from typing import Any

import numpy as np

from schemas.config import Config, ObserveConfig
from schemas.geometry import Camera, DepthImage
from schemas.manifest import ImageRow
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import redact_uri
from tableverse_factory.core.storage.untrusted import parse_finite, parse_json, read_bytes
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.geometry.math.camera import rescale_camera
from tableverse_factory.sources.capture import MAX_CAMERA_BYTES, MAX_FOCAL_PX, Capture
from tableverse_factory.sources.content_hash import CAMERA_SUFFIX, DEPTH_SUFFIX, find_sidecars
from tableverse_factory.sources.focal import check_field_of_view
from tableverse_factory.stages.observe.depth.estimate import MODEL_BEND, DepthEstimate, build_capture
from tableverse_factory.stages.observe.depth.rgb_image import read_rgb_image

MAX_BEND = 0.1
MAX_ASPECT_CHANGE = 0.02
_MAX_SIDE = 100_000


def read_recorded_depth(item: ImageRow, config: Config) -> Capture:
    """Read the depth in `NAME.depth.npy` and the camera in `NAME.camera.json` of a picture `NAME.jpg`."""
    photo = read_rgb_image(item.uri, config.observe)
    there = find_sidecars(item.uri)
    missing = [suffix for suffix in (DEPTH_SUFFIX, CAMERA_SUFFIX) if suffix not in there]
    if missing:
        stem = _get_file_name(item.uri).rpartition(".")[0]
        lacking = " and no ".join(stem + suffix for suffix in missing)
        raise InputError(
            f"observe.depth is 'recorded', and beside the picture there is no {lacking}", "no_recorded_depth"
        )
    depth = read_depth_array(there[DEPTH_SUFFIX], config.observe)
    camera, bend = read_recorded_camera(there[CAMERA_SUFFIX])
    height, width = photo.color.shape[:2]
    _check_aspect("the depth", depth.shape[1], depth.shape[0], width, height)
    _check_aspect("the camera", camera.width, camera.height, width, height)
    at_depth = rescale_camera(camera, depth.shape[1], depth.shape[0])
    estimate = DepthEstimate(depth, at_depth, bend, intrinsics_source="capture")
    return build_capture(photo.color, estimate, config.observe, _get_file_name(there[DEPTH_SUFFIX]))


def read_depth_array(uri: str, bounds: ObserveConfig) -> DepthImage:
    """Read depth from a `.npy` file [m]. Shape (h, w), float32."""
    name, data = _get_file_name(uri), read_bytes(uri, bounds.max_file_bytes, "unreadable_depth")
    try:
        values = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, OSError, EOFError, SyntaxError, TypeError, MemoryError, OverflowError) as error:
        raise InputError(f"{name} is no array of numbers as numpy.save writes it", "unreadable_depth") from error
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
    """Read intrinsics with their picture size, and the share by which the depth may be bent."""
    name = _get_file_name(uri)
    value = parse_json(read_bytes(uri, MAX_CAMERA_BYTES, "bad_intrinsics"), name, "bad_intrinsics")
    if not isinstance(value, dict):
        raise InputError(f"{name} holds no object of names and numbers", "bad_intrinsics")
    width, height = (round(_read_number(name, value, key, 1, _MAX_SIDE)) for key in ("width", "height"))
    fx, fy = (_read_number(name, value, key, 1e-3, MAX_FOCAL_PX) for key in ("fx", "fy"))
    cx, cy = _read_number(name, value, "cx", -0.5, width - 0.5), _read_number(name, value, "cy", -0.5, height - 0.5)
    bend = _read_number(name, value, "bend", 0.0, MAX_BEND) if "bend" in value else MODEL_BEND
    camera = Camera(fx, fy, cx, cy, width, height)
    check_field_of_view(camera, name)
    return camera, bend


def _get_file_name(uri: str) -> str:
    return sanitize_line(redact_uri(uri).rpartition("/")[2], 100)


def _read_number(name: str, value: dict[str, Any], key: str, low: float, high: float) -> float:
    number = parse_finite(value.get(key))
    if number is None or not low <= number <= high:
        said = f"is {sanitize_line(json.dumps(value[key]), 80)}" if key in value else "is missing"
        raise InputError(f"{name}: {key} {said}; give a finite number from {low:g} to {high:g}", "bad_intrinsics")
    return number


def _check_aspect(what: str, width: int, height: int, picture_width: int, picture_height: int) -> None:
    if abs(width * picture_height / (height * picture_width) - 1.0) > MAX_ASPECT_CHANGE + 1.0 / min(width, height):
        raise InputError(
            f"{what} is for {width} x {height} pixels, the picture {picture_width} x {picture_height} upright: it is "
            "of another picture, or of this one turned",
            "depth_size_differs",
        )
