"""Capture folder: `color.png` (or .jpg), `depth.png`, `camera.json`, and recorded answers beside them."""

import json
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import ValidationError

from schemas.config import ObserveConfig
from schemas.detection import Detections
from schemas.error_text import describe_validation_error
from schemas.geometry import Camera, DepthImage, IdImage, Picture, TriangleMesh
from schemas.observation import IntrinsicsSource, ScaleSource
from tableverse_factory.core.errors import GeometryError, InputError
from tableverse_factory.core.storage.untrusted import (
    decode_image,
    exists,
    list_file_names,
    open_image,
    parse_finite,
    parse_json,
    read_bytes,
)
from tableverse_factory.geometry.mesh.meshes import read_mesh
from tableverse_factory.sources.focal import check_field_of_view

COLOR_NAMES = ("color.png", "color.jpg", "color.jpeg")
DEPTH_NAME = "depth.png"
CAMERA_NAME = "camera.json"
DETECTIONS_NAME = "detections.json"
MASKS_NAME = "masks.png"
MESHES_NAME = "meshes"

DEPTH_MODES = ("I;16", "I;16B", "I;16L")
MAX_CAMERA_BYTES = 1024 * 1024
MAX_DETECTION_BYTES = 16 * 1024 * 1024
MAX_FOCAL_PX = 1e6
MAX_DEPTH_SCALE = 10.0
MAX_RECORDED_MESHES = 1024
_RECORDED_MESH = re.compile(r"[1-9][0-9]{0,9}\.obj")


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """Validated, pixel-aligned content of a capture folder.

    Attributes:
        depth: Shape (h, w) float32 [m], 0 where there is no reading or it lies beyond `observe.max_depth_m`.
        ids: Of `masks.png`, shape (h, w), 0 background; or None.
        bend: Share of the distance by which the depth may be bent smoothly; 0 of a sensor.
        scale_sigma: With `scale_source` and `intrinsics_source` as in `schemas.observation.Observation`.
    """

    color: Picture
    depth: DepthImage
    camera: Camera
    detections: Detections | None
    ids: IdImage | None
    bend: float = 0.0
    scale_sigma: float = 0.0
    scale_source: ScaleSource = "sensor"
    intrinsics_source: IntrinsicsSource = "capture"


def read_capture(folder_uri: str, bounds: ObserveConfig) -> Capture:
    """Read and check the whole folder.

    Raises:
        InputError: reasons `missing_color`, `unreadable_color`, `missing_depth`, `unreadable_depth`,
            `depth_not_16_bit`, `depth_size_differs`, `depth_all_zero`, `missing_camera`, `bad_intrinsics`,
            `bad_detections`, `bad_masks`, `picture_too_large`, `file_too_large`, `unreachable_uri`.
    """
    folder = folder_uri.rstrip("/")
    color = read_color(folder, bounds)
    camera, depth_scale = read_camera(folder, color.shape[1], color.shape[0])
    depth = read_depth(folder, bounds, camera, depth_scale)
    return Capture(color, depth, camera, read_detections(folder), read_ids(folder, bounds, camera))


def read_color(folder: str, bounds: ObserveConfig) -> Picture:
    """Read the first of `COLOR_NAMES` that exists, not turned by its EXIF, as the depth is not. Shape (h, w, 3)."""
    for name in COLOR_NAMES:
        if exists(f"{folder}/{name}"):
            data = read_bytes(f"{folder}/{name}", bounds.max_file_bytes, "unreadable_color")
            return decode_image(open_image(data, name, bounds, "unreadable_color"), name, "RGB", "unreadable_color")
    raise InputError(f"no {' or '.join(COLOR_NAMES)} in {folder!r}", "missing_color")


def read_camera(folder: str, width: int, height: int) -> tuple[Camera, float]:
    """Read intrinsics and metres per depth unit."""
    data = read_bytes(f"{folder}/{CAMERA_NAME}", MAX_CAMERA_BYTES, "missing_camera")
    value = parse_json(data, CAMERA_NAME, "bad_intrinsics")
    if not isinstance(value, dict):
        raise InputError(f"{CAMERA_NAME} holds no object of names and numbers", "bad_intrinsics")
    fx, fy = (_read_number(value, key, 1e-3, MAX_FOCAL_PX) for key in ("fx", "fy"))
    cx, cy = _read_number(value, "cx", -0.5, width - 0.5), _read_number(value, "cy", -0.5, height - 0.5)
    depth_scale = _read_number(value, "depth_scale", 1e-7, MAX_DEPTH_SCALE)
    size = (_read_number(value, "width", 1, 1e6), _read_number(value, "height", 1, 1e6))
    if size[0] != width or size[1] != height:
        sizes = f"{size[0]:g} x {size[1]:g} pixels, the picture is {width} x {height}"
        raise InputError(f"{CAMERA_NAME} is for {sizes}", "bad_intrinsics")
    camera = Camera(fx, fy, cx, cy, width, height)
    check_field_of_view(camera, CAMERA_NAME)
    return camera, depth_scale


def _read_number(value: dict[str, Any], key: str, low: float, high: float) -> float:
    if key not in value:
        raise InputError(f"{CAMERA_NAME} lacks {key}", "bad_intrinsics")
    number = parse_finite(value[key])
    if number is None or not low <= number <= high:
        given = f"{key} is {json.dumps(value[key])[:80]}"
        raise InputError(f"{CAMERA_NAME}: {given}; give a finite number from {low:g} to {high:g}", "bad_intrinsics")
    return number


def read_depth(folder: str, bounds: ObserveConfig, camera: Camera, depth_scale: float) -> DepthImage:
    """Read the depth in metres; 0 where it is not finite or beyond `observe.max_depth_m`. Shape (h, w) float32."""
    data = read_bytes(f"{folder}/{DEPTH_NAME}", bounds.max_file_bytes, "missing_depth")
    image = open_image(data, DEPTH_NAME, bounds, "unreadable_depth")
    if image.mode not in DEPTH_MODES:
        problem = f"{DEPTH_NAME} has pixels of mode {image.mode!r}; give a 16-bit greyscale PNG"
        raise InputError(problem, "depth_not_16_bit")
    if image.size != (camera.width, camera.height):
        sizes = f"{image.size[0]} x {image.size[1]}, the colour image {camera.width} x {camera.height}"
        raise InputError(f"{DEPTH_NAME} is {sizes}: register the depth to the colour image", "depth_size_differs")
    depth = decode_image(image, DEPTH_NAME, None, "unreadable_depth").astype(np.float32) * np.float32(depth_scale)
    if not depth.any():
        raise InputError(f"{DEPTH_NAME} holds no reading: every pixel is 0", "depth_all_zero")
    depth[~np.isfinite(depth) | (depth > bounds.max_depth_m)] = 0.0
    if not depth.any():
        raise InputError(
            f"{DEPTH_NAME} holds no reading within observe.max_depth_m = {bounds.max_depth_m:g} m; "
            f"is depth_scale = {depth_scale:g} right?",
            "depth_all_zero",
        )
    return depth


def read_detections(folder: str) -> Detections | None:
    """Read the recorded answer of a detector; None if there is none."""
    uri = f"{folder}/{DETECTIONS_NAME}"
    if not exists(uri):
        return None
    value = parse_json(read_bytes(uri, MAX_DETECTION_BYTES, "bad_detections"), DETECTIONS_NAME, "bad_detections")
    try:
        return Detections.model_validate(value)
    except ValidationError as error:
        raise InputError(f"{DETECTIONS_NAME}: {describe_validation_error(error)}"[:500], "bad_detections") from error


def read_ids(folder: str, bounds: ObserveConfig, camera: Camera) -> IdImage | None:
    """Read the recorded instance masks; None if there are none. Shape (h, w) int32."""
    uri = f"{folder}/{MASKS_NAME}"
    return read_id_image(uri, bounds, camera) if exists(uri) else None


def read_id_image(uri: str, bounds: ObserveConfig, camera: Camera) -> IdImage:
    """Read instance ids from an 8- or 16-bit PNG. Shape (h, w) int32."""
    name = uri.rsplit("/", 1)[-1]
    image = open_image(read_bytes(uri, bounds.max_file_bytes, "bad_masks"), name, bounds, "bad_masks")
    if image.mode not in ("L", "P", *DEPTH_MODES):
        raise InputError(f"{name} has pixels of mode {image.mode!r}; give one channel of 8 or 16 bit", "bad_masks")
    if image.size != (camera.width, camera.height):
        sizes = f"{image.size[0]} x {image.size[1]}, the colour image {camera.width} x {camera.height}"
        raise InputError(f"{name} is {sizes}", "bad_masks")
    return decode_image(image, name, None, "bad_masks").astype(np.int32)  # of a palette, the indices: they are the ids


def list_recorded_meshes(folder: str) -> tuple[str, ...]:
    """List the names in `meshes/` that `read_recorded_meshes` may read, sorted; none over HTTP."""
    names = tuple(name for name in list_file_names(f"{folder}/{MESHES_NAME}") if _RECORDED_MESH.fullmatch(name))
    if len(names) > MAX_RECORDED_MESHES:
        problem = f"{MESHES_NAME}/ holds {len(names)} meshes; at most {MAX_RECORDED_MESHES} are read"
        raise InputError(problem, "too_many_meshes")
    return names


def read_recorded_meshes(
    folder: str, ids: IdImage | None, bounds: ObserveConfig
) -> tuple[tuple[int, TriangleMesh], ...]:
    """Read the recorded `meshes/<instance id>.obj` of the ids in the masks, where they exist."""
    found: list[tuple[int, TriangleMesh]] = []
    for instance_id in [] if ids is None else np.unique(ids[ids > 0]).tolist():
        name = f"{MESHES_NAME}/{instance_id}.obj"
        uri = f"{folder.rstrip('/')}/{name}"
        if not exists(uri):
            continue
        try:
            found.append((instance_id, read_mesh(read_bytes(uri, bounds.max_file_bytes, "bad_mesh"), name)))
        except GeometryError as error:
            raise InputError(str(error), "bad_mesh") from error
    return tuple(found)
