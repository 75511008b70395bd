"""Depth Anything 3 (Lin et al. 2025): the metric model, and the nested one, which also estimates the camera.

The package is on git alone and was never run: its interface follows its pages and code; the conversion of its arrays
(`scale_to_metres`, `build_nested_estimate`) is tested.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from schemas.config import Config
from schemas.geometry import Picture
from schemas.manifest import ImageRow
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.models.local.batches import run_in_batches
from tableverse_factory.models.local.catalogue import DEFAULT_WEIGHTS
from tableverse_factory.models.local.device import import_torch, select_device
from tableverse_factory.models.local.hf_weights import resolve_source
from tableverse_factory.models.local.weights import load_foreign, load_once
from tableverse_factory.sources.capture import Capture
from tableverse_factory.stages.observe.depth.estimate import (
    DepthEstimate,
    build_capture,
    create_centered_camera,
    parse_intrinsics,
)
from tableverse_factory.stages.observe.depth.from_git import import_git_package
from tableverse_factory.stages.observe.depth.rgb_image import read_rgb_image

KEY = "observe.depth_weights"
CANONICAL_FOCAL_PX = 300.0
SKY = 0.3
MIN_CONFIDENCE = 0.25

_Map = Float[np.ndarray, "h w"]


def estimate_depth_anything_3(item: ImageRow, config: Config) -> Capture:
    """Estimate depth with the metric model (Apache-2.0); the focal length is as `RgbImage.choose_focal` tells it."""
    photo = read_rgb_image(item.uri, config.observe)
    focal = photo.choose_focal(config.observe.focal_px, item.known_length)
    depth, sky, confidence, _ = _predict_maps(photo.color, config, "depth_anything_3")
    if depth is None:
        raise AnswerInvalidError("Depth Anything 3 gave no depth", "depth_answer_invalid")
    estimate = scale_to_metres(depth, sky, confidence, focal.px, photo.color.shape)
    estimate = replace(estimate, intrinsics_source=focal.source)
    return build_capture(photo.color, estimate, config.observe)


def estimate_depth_anything_3_nested(item: ImageRow, config: Config) -> Capture:
    """Estimate metric depth and the camera with the nested model (CC BY-NC 4.0)."""
    photo = read_rgb_image(item.uri, config.observe)
    depth, sky, confidence, intrinsics = _predict_maps(photo.color, config, "depth_anything_3_nested")
    if depth is None or intrinsics is None or intrinsics.shape != (3, 3):
        raise AnswerInvalidError("Depth Anything 3 gave no depth or no intrinsics", "depth_answer_invalid")
    estimate = build_nested_estimate(depth, sky, confidence, intrinsics)
    return build_capture(photo.color, estimate, config.observe)


def scale_to_metres(
    output: _Map, sky: _Map | None, confidence: _Map | None, focal_px: float, shape: tuple[int, ...]
) -> DepthEstimate:
    """Scale the metric model's output, the depth for a focal length of 300 px at the model's resolution, to metres.

    `focal_px` is for a picture of `shape`, (h, w, …); where shrinking changes the aspect, the mean of both axes counts.
    """
    camera = create_centered_camera(focal_px, shape, output.shape)
    metres = output * ((camera.fx + camera.fy) / 2 / CANONICAL_FOCAL_PX)
    return DepthEstimate(mask_unreliable_depth(metres, sky, confidence), camera)


def build_nested_estimate(
    depth: _Map, sky: _Map | None, confidence: _Map | None, intrinsics: Float[np.ndarray, "3 3"]
) -> DepthEstimate:
    """Build the estimate of the nested model, depth and camera at its resolution."""
    rows, columns = depth.shape
    return DepthEstimate(mask_unreliable_depth(depth, sky, confidence), parse_intrinsics(intrinsics, columns, rows))


def mask_unreliable_depth(depth: _Map, sky: _Map | None, confidence: _Map | None) -> _Map:
    """Set depth to 0 for sky and for pixels of low confidence, which has no unit and is compared with its median."""
    is_reliable = np.isfinite(depth) & (depth > 0.0)
    if sky is not None:
        is_reliable &= np.asarray(sky, dtype=np.float32) < SKY
    if confidence is not None and is_reliable.any():
        is_reliable &= confidence >= MIN_CONFIDENCE * float(np.median(confidence[is_reliable]))
    return np.where(is_reliable, depth, 0.0).astype(np.float32)


def _predict_maps(color: Picture, config: Config, name: str) -> list[Any]:
    """Predict depth, sky, confidence and intrinsics, arrays or None; the seed is fixed, as large skies are sampled."""
    api = import_git_package("depth_anything_3.api")
    device, weights = select_device(config.models), config.observe.depth_weights or DEFAULT_WEIGHTS[name]
    source, at = resolve_source(weights, KEY)

    def make() -> Any:
        return api.DepthAnything3.from_pretrained(source, **at).to(device=device.torch_device).eval()

    model = load_once(("depth_anything_3", weights, device), lambda: load_foreign(make, weights, KEY))

    def run(pictures: Sequence[Picture], _: int) -> list[Any]:
        import_torch().manual_seed(0)
        return [model.inference([np.ascontiguousarray(picture)]) for picture in pictures]

    (prediction,), _ = run_in_batches(run, [color], 1)
    found = (getattr(prediction, field, None) for field in ("depth", "sky", "conf", "intrinsics"))
    return [None if value is None else np.asarray(value[0]) for value in found]
