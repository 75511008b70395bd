"""What depth models say of a picture, and how it becomes a capture: back at its size, in metres, within bounds."""

from dataclasses import dataclass

import numpy as np

from schemas.config import ObserveConfig
from schemas.geometry import Camera, DepthImage, Frozen, Picture
from tableverse_factory.core.errors import InputError
from tableverse_factory.sources.capture import Capture
from tableverse_factory.stages.observe.depth.resample import brought_back

MODEL_BEND = 0.015
"""Monocular depth is smooth and wrong by a few per cent in large patches; so much of the distance is allowed for."""
_METRES_OF_NO_TABLE = 100.0
"""Depth of which all is beyond this is in another unit."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthEstimate(Frozen):
    """Depth and camera of a picture at the resolution that the model worked at.

    Attributes:
        depth: Along the optical axis [m], shape (h, w); 0, negative or not finite where nothing is believed.
        camera: Intrinsics at that resolution; `width` and `height` are those of `depth`.
        bend: Share of the distance by which the depth may be bent smoothly; 0 of a sensor.
    """

    depth: DepthImage
    camera: Camera
    bend: float = MODEL_BEND


def camera_for(camera: Camera, width: int, height: int) -> Camera:
    """The same camera's intrinsics for a picture of another size; pixel centres at whole numbers."""
    x, y = width / camera.width, height / camera.height
    return Camera(camera.fx * x, camera.fy * y, (camera.cx + 0.5) * x - 0.5, (camera.cy + 0.5) * y - 0.5, width, height)


def centred(focal_x: float, focal_y: float, width: int, height: int) -> Camera:
    """A camera whose principal point is the middle of the picture."""
    return Camera(focal_x, focal_y, (width - 1) / 2, (height - 1) / 2, width, height)


def from_matrix(matrix: np.ndarray, width: int, height: int) -> Camera:
    """Intrinsics as a matrix, the picture's left and upper edge at 0, as networks give them; in pixels.

    Args:
        matrix: Shape (3, 3).
        width: Of the picture that it is for.
        height: Likewise.

    Raises:
        InputError: `bad_intrinsics`, if a model gave what no camera has.
    """
    fx, fy, cx, cy = (float(matrix[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    inside = 0.0 <= cx <= width and 0.0 <= cy <= height
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0.0 and fy > 0.0 and inside):
        said = f"fx {fx:.4g}, fy {fy:.4g}, cx {cx:.4g}, cy {cy:.4g}"
        raise InputError(f"the depth model gave {said} for {width} x {height} pixels: no camera", "bad_intrinsics")
    return Camera(fx, fy, cx - 0.5, cy - 0.5, width, height)


def capture_of(
    color: Picture, estimate: DepthEstimate, bounds: ObserveConfig, origin: str = "the depth model's answer"
) -> Capture:
    """The picture with the estimate's depth at its own size.

    Args:
        color: Shape (h, w, 3).
        estimate: At any size of nearly the same aspect.
        bounds: `max_depth_m`, beyond which nothing is believed.
        origin: What holds the depth, for messages.

    Raises:
        InputError: `depth_all_zero`, if no reading is left.
    """
    height, width = color.shape[:2]
    believed = np.isfinite(estimate.depth) & (estimate.depth > 0.0) & (estimate.depth <= bounds.max_depth_m)
    if not believed.any():
        read = estimate.depth[np.isfinite(estimate.depth) & (estimate.depth > 0.0)]
        nearest = f"the nearest is {read.min():.3g} m" if read.size else "no reading is finite and positive"
        unit = "; is it in millimetres?" if read.size and read.min() > _METRES_OF_NO_TABLE else ""
        raise InputError(
            f"{origin} holds no depth between 0 and observe.max_depth_m = {bounds.max_depth_m:g} m: {nearest}{unit}",
            "depth_all_zero",
        )
    depth = brought_back(np.where(believed, estimate.depth, 0.0), width, height, smeared=estimate.bend > 0.0)
    camera = camera_for(estimate.camera, width, height)
    return Capture(color, depth, camera, None, None, estimate.bend)
