"""Windows: the part of a picture that is worth a look."""

from dataclasses import replace

import numpy as np

from schemas.geometry import DepthImage
from tableverse_factory.evaluation.training.policy.packed_pictures import SIZE, WINDOW
from tableverse_factory.geometry.math.camera import PosedCamera, backproject
from tableverse_factory.geometry.math.transforms import transform_points

HEIGHTS_M = 0.006, 0.35  # over the table, of what stands on it
STRIDE = 4  # between the pixels, each way, that tell where the window is
LEAST_PIXELS = 20  # of those, that show what stands on the table
LEAST_REACH_M = 0.22  # from the axis of the arm's base, whose own links are nearer


def thin_eye(eye: PosedCamera) -> PosedCamera:
    """Keep every `STRIDE`th pixel of a camera, each way, from the first on."""
    own, (height, width) = eye.camera, SIZE
    fx, fy, cx, cy = (value / STRIDE for value in (own.fx, own.fy, own.cx, own.cy))
    camera = replace(own, fx=fx, fy=fy, cx=cx, cy=cy, width=width // STRIDE, height=height // STRIDE)
    return PosedCamera(camera, eye.camera_to_table)


def find_window(depth: DepthImage, thin: PosedCamera) -> tuple[int, int]:
    """Find the window about what stands on the table, or amid the picture where nothing does; return left and top [px].

    `depth` is what the camera of `thin_eye`, in the frame of the arm's base, sees [m], 0 where nothing is.
    """
    rows, columns = np.nonzero(depth)
    points = transform_points(thin.camera_to_table, backproject(depth, thin.camera)[rows, columns])
    low, high = HEIGHTS_M
    tall = (points[:, 2] > low) & (points[:, 2] < high) & (np.hypot(points[:, 0], points[:, 1]) > LEAST_REACH_M)
    size, window = np.array(SIZE[::-1]), np.array(WINDOW[::-1])
    pixels = STRIDE * np.stack([columns, rows], axis=1)[tall]
    ends = np.percentile(pixels, (2, 98), axis=0) if len(pixels) >= LEAST_PIXELS else np.array([[0, 0], size])
    left, top = np.clip(np.rint(ends.mean(axis=0) - window / 2).astype(int), 0, size - window).tolist()
    return left, top


def crop_eye(eye: PosedCamera, left: int, top: int) -> PosedCamera:
    """Crop a camera to the window that begins at these pixels."""
    height, width = WINDOW
    camera = replace(eye.camera, cx=eye.camera.cx - left, cy=eye.camera.cy - top, width=width, height=height)
    return PosedCamera(camera, eye.camera_to_table)
