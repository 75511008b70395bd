"""Pixels to points and back, for pinhole cameras with OpenCV axes."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Camera, DepthImage, Frozen, Points, Pose
from tableverse_factory.geometry.math.transforms import rotation_matrix


@dataclass(frozen=True, slots=True, eq=False)
class PosedCamera(Frozen):
    """A pinhole camera (OpenCV axes) and its pose in the table frame."""

    camera: Camera
    camera_to_table: Pose


def rescale_camera(camera: Camera, width: int, height: int) -> Camera:
    """Rescale intrinsics to another picture size; pixel centres are at whole numbers."""
    x, y = width / camera.width, height / camera.height
    return Camera(camera.fx * x, camera.fy * y, (camera.cx + 0.5) * x - 0.5, (camera.cy + 0.5) * y - 0.5, width, height)


def compute_field_of_view_deg(camera: Camera) -> float:
    """Compute the angle that the longer side of the picture spans [°]; the principal point may be anywhere."""
    size, focal, center = camera.width, camera.fx, camera.cx
    if camera.height > camera.width:
        size, focal, center = camera.height, camera.fy, camera.cy
    before, behind = center + 0.5, size - 0.5 - center
    return float(np.degrees(np.arctan(before / focal) + np.arctan(behind / focal)))


def backproject(depth: DepthImage, camera: Camera) -> Float64[np.ndarray, "h w 3"]:
    """Points in the camera frame [m], pixel by pixel; zero depth gives the origin."""
    z = np.asarray(depth, dtype=np.float64)
    v, u = np.indices(z.shape, dtype=np.float64)
    return np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)


def compute_pixel_rays(
    camera: Camera, camera_to_scene: Pose, offset: tuple[float, float] = (0.0, 0.0)
) -> Float64[np.ndarray, "h w 3"]:
    """Compute directions through the pixels, `offset` from their centres [px], of length 1 along the optical axis."""
    x = (np.arange(camera.width) + offset[0] - camera.cx) / camera.fx
    y = (np.arange(camera.height) + offset[1] - camera.cy) / camera.fy
    right, down, forward = rotation_matrix(camera_to_scene.quaternion_wxyz).T
    return x[None, :, None] * right + (y[:, None, None] * down + forward)


def project(points_camera: Points, camera: Camera) -> Float64[np.ndarray, "n 2"]:
    """Pixel coordinates (u, v) of points in front of the camera; NaN for points behind it."""
    z = np.where(points_camera[:, 2] > 1e-9, points_camera[:, 2], np.nan)
    u = points_camera[:, 0] / z * camera.fx + camera.cx
    v = points_camera[:, 1] / z * camera.fy + camera.cy
    return np.stack([u, v], axis=-1)
