"""Depth Anything 3 (Lin et al. 2025): its metric model, and the nested one, which tells the camera too.

The package is on git alone, so nothing here could be run against it: what it takes and gives is as its own pages and
code say, and what is made of its arrays (`metric_estimate`, `nested_estimate`) is tested by itself.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from schemas.config import Config
from schemas.geometry import Picture
from schemas.manifest import ImageRow
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.models.local.batches import in_batches
from tableverse_factory.models.local.device import device_of, torch_here
from tableverse_factory.models.local.hf_weights import PUBLISHED, source
from tableverse_factory.models.local.weights import foreign, loaded
from tableverse_factory.sources.capture import Capture
from tableverse_factory.stages.observe.depth.estimate import DepthEstimate, camera_for, capture_of, centred, from_matrix
from tableverse_factory.stages.observe.depth.from_git import package
from tableverse_factory.stages.observe.depth.rgb_image import read_photograph

KEY = "observe.depth_weights"
CANONICAL_FOCAL_PX = 300.0
SKY = 0.3
MIN_CONFIDENCE = 0.25

_Map = Float[np.ndarray, "h w"]


def depth_anything_3(item: ImageRow, config: Config) -> Capture:
    """The metric model (Apache-2.0): needs the focal length, by EXIF or `observe.focal_px`.

    Raises:
        InputError: `no_focal_length`, `depth_all_zero`, or as `read_photograph`.
        ModelAccessError: without the package or the weights.
    """
    photo = read_photograph(item.uri, config.observe)
    focal = photo.focal_px(config.observe.focal_px)
    said = _asked(photo.color, config, config.observe.depth_weights or PUBLISHED["depth_anything_3"])
    height, width = photo.color.shape[:2]
    depth, sky, confidence = _map(said, "depth"), _map(said, "sky"), _map(said, "conf")
    if depth is None:
        raise AnswerInvalidError("Depth Anything 3 gave no depth", "depth_answer_invalid")
    return capture_of(photo.color, metric_estimate(depth, sky, confidence, focal, width, height), config.observe)


def depth_anything_3_nested(item: ImageRow, config: Config) -> Capture:
    """The nested model (CC BY-NC 4.0), which estimates metres and the camera.

    Raises:
        InputError: `depth_all_zero`, `bad_intrinsics`, or as `read_photograph`.
        ModelAccessError: without the package or the weights.
    """
    photo = read_photograph(item.uri, config.observe)
    said = _asked(photo.color, config, config.observe.depth_weights or PUBLISHED["depth_anything_3_nested"])
    depth, intrinsics = _map(said, "depth"), _map(said, "intrinsics")
    if depth is None or intrinsics is None or intrinsics.shape != (3, 3):
        raise AnswerInvalidError("Depth Anything 3 gave no depth or no intrinsics", "depth_answer_invalid")
    estimate = nested_estimate(depth, _map(said, "sky"), _map(said, "conf"), intrinsics)
    return capture_of(photo.color, estimate, config.observe)


def metric_estimate(
    output: _Map, sky: _Map | None, confidence: _Map | None, focal_px: float, width: int, height: int
) -> DepthEstimate:
    """Metres of the metric model's output, which is the depth that a camera of 300 px would see.

    The focal length counts at the model's own resolution, at which it saw the picture: for a picture of 4,000 pixels
    that it shrank to 504, a focal length of 3,000 px is one of 378, and that of the file would put everything eight
    times too far. Where shrinking changed the aspect, the mean of both axes counts.

    Args:
        output: Of the model.
        sky: How much each pixel is sky, 0 to 1, or whether; None where it was not told.
        confidence: Of the model, without unit; None where it was not told.
        focal_px: Of the picture.
        width: Of the picture.
        height: Of the picture.
    """
    rows, columns = output.shape
    camera = camera_for(centred(focal_px, focal_px, width, height), columns, rows)
    metres = output * ((camera.fx + camera.fy) / 2 / CANONICAL_FOCAL_PX)
    return DepthEstimate(believed(metres, sky, confidence), camera)


def nested_estimate(
    depth: _Map, sky: _Map | None, confidence: _Map | None, intrinsics: Float[np.ndarray, "3 3"]
) -> DepthEstimate:
    """Metres and camera as the nested model gives them, both at its own resolution.

    Raises:
        InputError: `bad_intrinsics`, if the camera is none.
    """
    rows, columns = depth.shape
    return DepthEstimate(believed(depth, sky, confidence), from_matrix(intrinsics, columns, rows))


def believed(depth: _Map, sky: _Map | None, confidence: _Map | None) -> _Map:
    """The depth, 0 where the model sees sky or trusts itself far less than in the rest of the picture.

    The confidence has no unit, and each set of weights another range: it is held against its own median.
    """
    kept = np.isfinite(depth) & (depth > 0.0)
    if sky is not None:
        kept &= np.asarray(sky, dtype=np.float32) < SKY
    if confidence is not None and kept.any():
        kept &= confidence >= MIN_CONFIDENCE * float(np.median(confidence[kept]))
    result: _Map = np.where(kept, depth, 0.0).astype(np.float32)
    return result


def _asked(color: Picture, config: Config, weights: str) -> Any:
    """What the package says of one picture. Of much sky it draws a sample, which is why its generator is set."""
    api = package("depth_anything_3.api")
    device = device_of(config.models)
    name, at = source(weights, KEY)

    def make() -> Any:
        return api.DepthAnything3.from_pretrained(name, **at).to(device=device.where).eval()

    model = loaded(("depth_anything_3", weights, device), lambda: foreign(make, weights, KEY))

    def run(pictures: Sequence[Picture], _: int) -> list[Any]:
        torch_here().manual_seed(0)
        return [model.inference([np.ascontiguousarray(picture)]) for picture in pictures]

    (said,), _ = in_batches(run, [color], 1)
    return said


def _map(said: Any, name: str) -> Any:
    """The first picture's part of an answer as an array, None where there is none."""
    value = getattr(said, name, None)
    return None if value is None else np.asarray(value[0])
