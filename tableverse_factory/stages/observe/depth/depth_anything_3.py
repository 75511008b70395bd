"""Depth Anything 3 (Lin et al. 2025): the metric model, and the nested one, which also estimates the camera.

The package is on git alone and could not be run here: its interface follows its pages and code, and the conversion of
its arrays (`scale_to_metres`, `build_nested_estimate`) is tested by itself.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from schemas.config import Config
from schemas.geometry import Picture
from schemas.manifest import ImageRow
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.models.local.batches import run_in_batches
from tableverse_factory.models.local.device import import_torch, select_device
from tableverse_factory.models.local.hf_weights import DEFAULT_WEIGHTS, resolve_source
from tableverse_factory.models.local.weights import load_foreign, load_once
from tableverse_factory.sources.capture import Capture
from tableverse_factory.stages.observe.depth.estimate import (
    DepthEstimate,
    build_capture,
    create_centered_camera,
    parse_intrinsics,
    rescale_camera,
)
from tableverse_factory.stages.observe.depth.from_git import import_git_package
from tableverse_factory.stages.observe.depth.rgb_image import read_rgb_image

KEY = "observe.depth_weights"
CANONICAL_FOCAL_PX = 300.0
SKY = 0.3
MIN_CONFIDENCE = 0.25

_Map = Float[np.ndarray, "h w"]


def estimate_depth_anything_3(item: ImageRow, config: Config) -> Capture:
    """Estimate depth with the metric model (Apache-2.0); the focal length comes from EXIF or `observe.focal_px`.

    Raises:
        InputError: `no_focal_length`, `depth_all_zero`, or as `read_rgb_image`.
        ModelAccessError: without the package or the weights.
    """
    photo = read_rgb_image(item.uri, config.observe)
    focal = photo.get_focal_px(config.observe.focal_px)
    prediction = _run_inference(
        photo.color, config, config.observe.depth_weights or DEFAULT_WEIGHTS["depth_anything_3"]
    )
    height, width = photo.color.shape[:2]
    depth, sky, confidence = _get_map(prediction, "depth"), _get_map(prediction, "sky"), _get_map(prediction, "conf")
    if depth is None:
        raise AnswerInvalidError("Depth Anything 3 gave no depth", "depth_answer_invalid")
    return build_capture(photo.color, scale_to_metres(depth, sky, confidence, focal, width, height), config.observe)


def estimate_depth_anything_3_nested(item: ImageRow, config: Config) -> Capture:
    """Estimate metric depth and the camera with the nested model (CC BY-NC 4.0).

    Raises:
        InputError: `depth_all_zero`, `bad_intrinsics`, or as `read_rgb_image`.
        ModelAccessError: without the package or the weights.
    """
    photo = read_rgb_image(item.uri, config.observe)
    prediction = _run_inference(
        photo.color, config, config.observe.depth_weights or DEFAULT_WEIGHTS["depth_anything_3_nested"]
    )
    depth, intrinsics = _get_map(prediction, "depth"), _get_map(prediction, "intrinsics")
    if depth is None or intrinsics is None or intrinsics.shape != (3, 3):
        raise AnswerInvalidError("Depth Anything 3 gave no depth or no intrinsics", "depth_answer_invalid")
    estimate = build_nested_estimate(depth, _get_map(prediction, "sky"), _get_map(prediction, "conf"), intrinsics)
    return build_capture(photo.color, estimate, config.observe)


def scale_to_metres(
    output: _Map, sky: _Map | None, confidence: _Map | None, focal_px: float, width: int, height: int
) -> DepthEstimate:
    """Scale the metric model's output, the depth for a focal length of 300 px, to metres.

    The focal length is that at the model's resolution: for a picture of 4,000 pixels that is shrunk to 504, a focal
    length of 3,000 px becomes 378 px. Where shrinking changes the aspect ratio, the mean of both axes is used.

    Args:
        output: Depth map of the model.
        sky: Probability or mask of sky; None if unknown.
        confidence: Confidence without unit; None if unknown.
        focal_px: Focal length of the picture [px].
        width: Width of the picture [px].
        height: Height of the picture [px].
    """
    rows, columns = output.shape
    camera = rescale_camera(create_centered_camera(focal_px, focal_px, width, height), columns, rows)
    metres = output * ((camera.fx + camera.fy) / 2 / CANONICAL_FOCAL_PX)
    return DepthEstimate(mask_unreliable_depth(metres, sky, confidence), camera)


def build_nested_estimate(
    depth: _Map, sky: _Map | None, confidence: _Map | None, intrinsics: Float[np.ndarray, "3 3"]
) -> DepthEstimate:
    """Build the estimate of the nested model, depth and camera at its resolution.

    Raises:
        InputError: `bad_intrinsics` for invalid intrinsics.
    """
    rows, columns = depth.shape
    return DepthEstimate(mask_unreliable_depth(depth, sky, confidence), parse_intrinsics(intrinsics, columns, rows))


def mask_unreliable_depth(depth: _Map, sky: _Map | None, confidence: _Map | None) -> _Map:
    """Set depth to 0 for sky and for pixels of low confidence.

    Confidence has no unit, and its range depends on the weights, so it is compared with its median.
    """
    is_reliable = np.isfinite(depth) & (depth > 0.0)
    if sky is not None:
        is_reliable &= np.asarray(sky, dtype=np.float32) < SKY
    if confidence is not None and is_reliable.any():
        is_reliable &= confidence >= MIN_CONFIDENCE * float(np.median(confidence[is_reliable]))
    return np.where(is_reliable, depth, 0.0).astype(np.float32)


def _run_inference(color: Picture, config: Config, weights: str) -> Any:
    """Run the package on one picture, with a fixed seed: it samples pixels of large skies."""
    api = import_git_package("depth_anything_3.api")
    device = select_device(config.models)
    name, at = resolve_source(weights, KEY)

    def make() -> Any:
        return api.DepthAnything3.from_pretrained(name, **at).to(device=device.torch_device).eval()

    model = load_once(("depth_anything_3", weights, device), lambda: load_foreign(make, weights, KEY))

    def run(pictures: Sequence[Picture], _: int) -> list[Any]:
        import_torch().manual_seed(0)
        return [model.inference([np.ascontiguousarray(picture)]) for picture in pictures]

    (prediction,), _ = run_in_batches(run, [color], 1)
    return prediction


def _get_map(prediction: Any, name: str) -> Any:
    value = getattr(prediction, name, None)
    return None if value is None else np.asarray(value[0])
