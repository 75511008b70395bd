"""Depth Anything V2, metric (Yang et al. 2024), by transformers: light enough for a CPU; it tells no camera."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32

from schemas.config import Config
from schemas.geometry import Picture
from schemas.manifest import ImageRow
from tableverse_factory.core.errors import ModelAccessError
from tableverse_factory.models.local.batches import in_batches
from tableverse_factory.models.local.device import Device, device_of, torch_here
from tableverse_factory.models.local.hf_weights import PUBLISHED
from tableverse_factory.models.local.pixels import IMAGENET, picture_on, pixel_values
from tableverse_factory.models.local.weights import loaded, pretrained
from tableverse_factory.sources.capture import Capture
from tableverse_factory.stages.observe.depth.estimate import DepthEstimate, camera_for, capture_of, centred
from tableverse_factory.stages.observe.depth.rgb_image import read_photograph

NAME = "depth_anything_2"
SIDE_PX = 518


def depth_anything_2(item: ImageRow, config: Config) -> Capture:
    """The picture with the depth of the model's metric head; the focal length is by EXIF or `observe.focal_px`.

    Raises:
        InputError: `no_focal_length`, `depth_all_zero`, or as `read_photograph`.
        ModelAccessError: without torch, transformers or weights, or with weights of a relative model.
    """
    photo = read_photograph(item.uri, config.observe)
    focal = photo.focal_px(config.observe.focal_px)
    depth = metric_depth(photo.color, config.observe.depth_weights or PUBLISHED[NAME], device_of(config.models))
    height, width = photo.color.shape[:2]
    camera = camera_for(centred(focal, focal, width, height), depth.shape[1], depth.shape[0])
    return capture_of(photo.color, DepthEstimate(depth, camera), config.observe)


def metric_depth(color: Picture, weights: str, device: Device) -> Float32[np.ndarray, "h w"]:
    """Metres at the model's own resolution.

    Raises:
        ModelAccessError: see `depth_anything_2`.
        ModelError: where the memory is not enough.
    """
    model = loaded((NAME, weights, device), lambda: _metric(weights, device))
    torch = torch_here()
    size = process_size(color.shape[0], color.shape[1], int(model.config.patch_size))

    def run(pictures: Sequence[Picture], _: int) -> list[Float32[np.ndarray, "h w"]]:
        with torch.inference_mode():
            on_device = [picture_on(picture, device) for picture in pictures]
            said = model(pixel_values(on_device, size, IMAGENET, device, "bicubic")).predicted_depth
            return list(said.to(torch.float32).cpu().numpy())

    (depth,), _ = in_batches(run, [color], 1)
    return depth


def process_size(height: int, width: int, patch: int) -> tuple[int, int]:
    """Height and width for the model: that side near `SIDE_PX` which changes less so, each a multiple of its patches.

    So the model's own processor does it, and it was trained: 240 x 320 becomes 392 x 518, 1536 x 2048 518 x 686.
    """
    scale = min((SIDE_PX / height, SIDE_PX / width), key=lambda scale: abs(1.0 - scale))
    rows, columns = (max(1, round(side * scale / patch)) * patch for side in (height, width))
    return rows, columns


def _metric(weights: str, device: Device) -> Any:
    model = pretrained("DepthAnythingForDepthEstimation", weights, device, "observe.depth_weights", ("depth_anything",))
    if model.config.depth_estimation_type != "metric":
        raise ModelAccessError(
            f"observe.depth_weights = {weights!r} is a relative model, which gives no metres: take a metric one, like "
            f"{PUBLISHED[NAME]}"
        )
    return model
