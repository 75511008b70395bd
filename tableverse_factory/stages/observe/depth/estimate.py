"""Estimates of depth models, and their conversion to captures."""

from dataclasses import dataclass

import numpy as np

from schemas.config import ObserveConfig
from schemas.geometry import Camera, DepthImage, Frozen, Picture
from schemas.observation import IntrinsicsSource, ScaleSource
from tableverse_factory.core.errors import InputError
from tableverse_factory.geometry.math.camera import rescale_camera
from tableverse_factory.sources.capture import Capture
from tableverse_factory.stages.observe.depth.resample import resample_depth

MODEL_BEND = 0.015  # share of the distance by which monocular depth may be bent smoothly
_IMPLAUSIBLE_M = 100.0  # A depth map entirely beyond this is probably in another unit [m]


@dataclass(frozen=True, slots=True, eq=False)
class DepthEstimate(Frozen):
    """Depth along the optical axis [m], 0, negative or not finite where unknown, and the camera for its size.

    `bend` is the share of the distance by which the depth may be bent smoothly; 0 for a sensor, which measures
    the scale too.
    """

    depth: DepthImage
    camera: Camera
    bend: float = MODEL_BEND
    intrinsics_source: IntrinsicsSource = "model"


def create_centered_camera(focal_px: float, shape: tuple[int, ...], scaled: tuple[int, ...]) -> Camera:
    """Create the camera of a picture of `shape`, (h, w, …), scaled to another shape; the principal point is central."""
    height, width = shape[:2]
    camera = Camera(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, width, height)
    return rescale_camera(camera, scaled[1], scaled[0])


def parse_intrinsics(matrix: np.ndarray, width: int, height: int) -> Camera:
    """Convert intrinsics as networks give them: shape (3, 3) [px], the picture's left and upper edge at 0."""
    fx, fy, cx, cy = (float(matrix[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    inside = 0.0 <= cx <= width and 0.0 <= cy <= height
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0.0 and fy > 0.0 and inside):
        values = f"fx {fx:.4g}, fy {fy:.4g}, cx {cx:.4g}, cy {cy:.4g}"
        raise InputError(f"the depth model gave {values} for {width} x {height} pixels: no camera", "bad_intrinsics")
    return Camera(fx, fy, cx - 0.5, cy - 0.5, width, height)


def build_capture(
    color: Picture, estimate: DepthEstimate, bounds: ObserveConfig, origin: str = "the depth model's answer"
) -> Capture:
    """Build a capture with the estimated depth at the size of the picture, whose aspect ratio is nearly the same.

    Depth beyond `observe.max_depth_m` is ignored; `origin` names the source of the depth in messages.
    """
    height, width = color.shape[:2]
    is_valid = np.isfinite(estimate.depth) & (estimate.depth > 0.0) & (estimate.depth <= bounds.max_depth_m)
    if not is_valid.any():
        read = estimate.depth[np.isfinite(estimate.depth) & (estimate.depth > 0.0)]
        nearest = f"the nearest is {read.min():.3g} m" if read.size else "no reading is finite and positive"
        unit = "; is it in millimetres?" if read.size and read.min() > _IMPLAUSIBLE_M else ""
        raise InputError(
            f"{origin} holds no depth between 0 and observe.max_depth_m = {bounds.max_depth_m:g} m: {nearest}{unit}",
            "depth_all_zero",
        )
    depth = resample_depth(np.where(is_valid, estimate.depth, 0.0), width, height, smeared=estimate.bend > 0.0)
    camera = rescale_camera(estimate.camera, width, height)
    scale_source: ScaleSource = "estimated" if estimate.bend > 0.0 else "sensor"
    return Capture(
        color,
        depth,
        camera,
        None,
        None,
        estimate.bend,
        scale_source=scale_source,
        intrinsics_source=estimate.intrinsics_source,
    )
