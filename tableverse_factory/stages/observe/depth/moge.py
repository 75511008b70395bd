"""MoGe-2 (Wang et al. 2025): metric points, a mask of what has any, and the camera, all at the picture's own size.

The package is on git alone, so nothing here could be run against it: what it takes and gives is as its own code says,
and what is made of its arrays (`moge_estimate`) is tested by itself.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from schemas.config import Config
from schemas.geometry import Picture
from schemas.manifest import ImageRow
from tableverse_factory.models.local.batches import in_batches
from tableverse_factory.models.local.device import device_of, torch_here
from tableverse_factory.models.local.hf_weights import PUBLISHED, source
from tableverse_factory.models.local.weights import foreign, loaded
from tableverse_factory.sources.capture import Capture
from tableverse_factory.stages.observe.depth.estimate import DepthEstimate, capture_of, from_matrix
from tableverse_factory.stages.observe.depth.from_git import package
from tableverse_factory.stages.observe.depth.rgb_image import read_photograph

KEY = "observe.depth_weights"
CHECKPOINT = "model.pt"


def moge_2(item: ImageRow, config: Config) -> Capture:
    """The picture with MoGe-2's depth and camera.

    Raises:
        InputError: `depth_all_zero`, `bad_intrinsics`, or as `read_photograph`.
        ModelAccessError: without the package or the weights.
        ModelError: where the memory is not enough.
    """
    photo = read_photograph(item.uri, config.observe)
    model_type = package("moge.model.v2").MoGeModel
    device = device_of(config.models)
    weights = config.observe.depth_weights or PUBLISHED["moge_2"]
    name, at = source(weights, KEY)

    def make() -> Any:
        return model_type.from_pretrained(_checkpoint(name), **at).to(device.where).eval()

    model = loaded(("moge_2", weights, device), lambda: foreign(make, weights, KEY))

    def run(pictures: Sequence[Picture], _: int) -> list[dict[str, Any]]:
        torch = torch_here()
        planes = (torch.from_numpy(np.ascontiguousarray(p)).to(device.where).permute(2, 0, 1) for p in pictures)
        half = device.precision != "float32"
        return [model.infer(plane.to(torch.float32) / 255.0, use_fp16=half) for plane in planes]

    (said,), _ = in_batches(run, [photo.color], 1)
    return capture_of(photo.color, moge_estimate(*_arrays(said)), config.observe)


def moge_estimate(
    depth: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], intrinsics: Float[np.ndarray, "3 3"]
) -> DepthEstimate:
    """Depth and camera in pixels.

    Args:
        depth: Metres, infinite where there is none.
        mask: Where there is depth.
        intrinsics: Of a picture whose width and height are 1.

    Raises:
        InputError: `bad_intrinsics`, if the camera is none.
    """
    height, width = depth.shape
    pixels = intrinsics * np.array([[width], [height], [1.0]])
    return DepthEstimate(np.where(mask, depth, 0.0).astype(np.float32), from_matrix(pixels, width, height))


def _arrays(said: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    depth, intrinsics = (said[name].detach().float().cpu().numpy() for name in ("depth", "intrinsics"))
    mask = said["mask"].detach().cpu().numpy() if "mask" in said else np.isfinite(depth)
    return depth, mask.astype(bool), intrinsics


def _checkpoint(weights: str) -> str:
    """The package wants the file of a local model, and the name of one on the hub."""
    return str(Path(weights) / CHECKPOINT) if Path(weights).is_dir() else weights
