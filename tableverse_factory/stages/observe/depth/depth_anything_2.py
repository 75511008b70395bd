"""Metric Depth Anything V2 (Yang et al. 2024) from transformers: runs on a CPU; estimates no camera."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32

from schemas.config import Config
from schemas.geometry import Picture
from schemas.manifest import ImageRow
from tableverse_factory.core.errors import WeightsError
from tableverse_factory.models.local.batches import run_in_batches
from tableverse_factory.models.local.catalogue import DEFAULT_WEIGHTS
from tableverse_factory.models.local.device import Device, import_torch, select_device
from tableverse_factory.models.local.pixels import IMAGENET, compute_pixel_values, upload_image
from tableverse_factory.models.local.weights import load_once, load_pretrained
from tableverse_factory.sources.capture import Capture
from tableverse_factory.stages.observe.depth.estimate import DepthEstimate, build_capture, create_centered_camera
from tableverse_factory.stages.observe.depth.rgb_image import read_rgb_image

NAME = "depth_anything_2"
SIDE_PX = 518  # side to which the model's own processor scales


def estimate_depth_anything_2(item: ImageRow, config: Config) -> Capture:
    """Estimate metric depth; the focal length comes as `RgbImage.choose_focal` tells it."""
    photo = read_rgb_image(item.uri, config.observe)
    focal = photo.choose_focal(config.observe.focal_px, item.known_length)
    depth = predict_metric_depth(
        photo.color, config.observe.depth_weights or DEFAULT_WEIGHTS[NAME], select_device(config.models)
    )
    camera = create_centered_camera(focal.px, photo.color.shape, depth.shape)
    estimate = DepthEstimate(depth, camera, intrinsics_source=focal.source)
    return build_capture(photo.color, estimate, config.observe)


def predict_metric_depth(color: Picture, weights: str, device: Device) -> Float32[np.ndarray, "h w"]:
    """Predict depth at the model's resolution [m]."""
    model = load_once((NAME, weights, device), lambda: _load_metric_model(weights, device))
    torch = import_torch()
    size = compute_input_size(color.shape[0], color.shape[1], int(model.config.patch_size))

    def run(pictures: Sequence[Picture], _: int) -> list[Float32[np.ndarray, "h w"]]:
        with torch.inference_mode():
            on_device = [upload_image(picture, device) for picture in pictures]
            predicted = model(compute_pixel_values(on_device, size, IMAGENET, device, "bicubic")).predicted_depth
            return list(predicted.to(torch.float32).cpu().numpy())

    (depth,), _ = run_in_batches(run, [color], 1)
    return depth


def compute_input_size(height: int, width: int, patch: int) -> tuple[int, int]:
    """Compute rows and columns of the input: the side that changes less becomes about `SIDE_PX`, both whole patches."""
    scale = min((SIDE_PX / height, SIDE_PX / width), key=lambda scale: abs(1.0 - scale))
    rows, columns = (max(1, round(side * scale / patch)) * patch for side in (height, width))
    return rows, columns


def _load_metric_model(weights: str, device: Device) -> Any:
    model = load_pretrained(
        "DepthAnythingForDepthEstimation", weights, device, "observe.depth_weights", ("depth_anything",)
    )
    if model.config.depth_estimation_type != "metric":
        raise WeightsError(
            f"observe.depth_weights = {weights!r} is a relative model, which gives no metres; use a metric one, like "
            f"{DEFAULT_WEIGHTS[NAME]}"
        )
    return model
