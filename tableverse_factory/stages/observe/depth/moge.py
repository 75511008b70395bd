"""MoGe-2 (Wang et al. 2025): metric depth, a mask of valid pixels and the camera, at the picture's size.

Held to the authors' code, version 2.0, with random weights; published weights have not been run.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from schemas.config import Config
from schemas.geometry import Picture
from schemas.manifest import ImageRow
from tableverse_factory.models.local.batches import run_in_batches
from tableverse_factory.models.local.catalogue import DEFAULT_WEIGHTS
from tableverse_factory.models.local.device import import_torch, select_device
from tableverse_factory.models.local.hf_weights import resolve_source
from tableverse_factory.models.local.weights import load_foreign, load_once
from tableverse_factory.sources.capture import Capture
from tableverse_factory.stages.observe.depth.estimate import DepthEstimate, build_capture, parse_intrinsics
from tableverse_factory.stages.observe.depth.from_git import MOGE_CHECKPOINT, import_git_package
from tableverse_factory.stages.observe.depth.rgb_image import read_rgb_image

KEY = "observe.depth_weights"


def estimate_moge_2(item: ImageRow, config: Config) -> Capture:
    """Estimate metric depth and the camera."""
    photo = read_rgb_image(item.uri, config.observe)
    model_type = import_git_package("moge.model.v2").MoGeModel
    device = select_device(config.models)
    weights = config.observe.depth_weights or DEFAULT_WEIGHTS["moge_2"]
    name, at = resolve_source(weights, KEY)

    def make() -> Any:
        checkpoint = str(Path(name) / MOGE_CHECKPOINT) if Path(name).is_dir() else name
        return model_type.from_pretrained(checkpoint, **at).to(device.torch_device).eval()

    model = load_once(("moge_2", weights, device), lambda: load_foreign(make, weights, KEY))

    def run(pictures: Sequence[Picture], _: int) -> list[dict[str, Any]]:
        torch = import_torch()
        planes = (torch.tensor(p).to(device.torch_device).permute(2, 0, 1) for p in pictures)
        half = device.precision != "float32"
        return [model.infer(plane.to(torch.float32) / 255.0, use_fp16=half) for plane in planes]

    (prediction,), _ = run_in_batches(run, [photo.color], 1)
    return build_capture(photo.color, build_moge_estimate(*_get_arrays(prediction)), config.observe)


def build_moge_estimate(
    depth: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], intrinsics: Float[np.ndarray, "3 3"]
) -> DepthEstimate:
    """Build the estimate from depth [m], the pixels that have any, and intrinsics for a picture of 1 x 1."""
    height, width = depth.shape
    pixels = intrinsics * np.array([[width], [height], [1.0]])
    return DepthEstimate(np.where(mask, depth, 0.0).astype(np.float32), parse_intrinsics(pixels, width, height))


def _get_arrays(prediction: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    depth, intrinsics = (prediction[name].detach().float().cpu().numpy() for name in ("depth", "intrinsics"))
    mask = prediction["mask"].detach().cpu().numpy() if "mask" in prediction else np.isfinite(depth)
    return depth, mask.astype(bool), intrinsics
