"""Focal length of a picture in which the corners of a sheet of known size are marked."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from schemas.known_length import Pixel, get_pixel_std
from schemas.observation import IntrinsicsSource

CENTER_STD = 0.03  # standard deviation of the principal point from the middle of a picture, in longer sides
MAX_COST = 10.0  # of corners that make a sheet; 1 % of true ones have 9.2 and more, with two degrees of freedom
MIN_ADVANTAGE = 9.0  # by which the other side must fit worse as the longer one, else nobody knows which it is
MAX_SIGMA = 0.75  # of what is known without the sheet: one that is small, or seen from straight above, tells nothing

Corners = Float64[np.ndarray, "4 2"]


class Focal(NamedTuple):
    """A focal length [px], the standard deviation of its logarithm, 0 where it is told, and where it comes from."""

    px: float
    sigma: float
    source: IntrinsicsSource

    @property
    def is_guessed(self) -> bool:
        """Whether nothing tells it."""
        return self.source == "assumed" and self.sigma > 0.0


def make_sheet(sides_m: tuple[float, float]) -> Float64[np.ndarray, "4 3"]:
    """Make the corners of a sheet about its middle, once around, at z = 0 [m]."""
    return np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / 2 * [*sides_m, 0.0]


def estimate_sheet_focal(
    pixels: Sequence[Pixel], sides_m: tuple[float, float], size: tuple[int, int], usual: Focal
) -> Focal | None:
    """Estimate the focal length with which the corners of a sheet span its sides; None where they do not tell.

    The corners lie in a picture of `size` (width, height), and are off by `get_pixel_std`; `usual` is what is known
    without them. The most probable pose, focal length and principal point explain both.
    """
    std, center_std = get_pixel_std(size) / usual.px, CENTER_STD * max(size) / usual.px
    corners = (np.array(pixels) - (np.array(size) - 1) / 2) / usual.px
    prior = np.array([usual.sigma, center_std, center_std])
    fits = [_fit(corners, sides, std, prior) for sides in (sides_m, sides_m[::-1])]
    (log_ratio, sigma, cost), (*_, other) = sorted(fits, key=lambda fit: fit[2])
    if cost > MAX_COST or other < cost + MIN_ADVANTAGE or not sigma <= MAX_SIGMA * usual.sigma:
        return None
    return Focal(usual.px * float(np.exp(log_ratio)), sigma, "sheet")


def _fit(
    corners: Corners, sides_m: tuple[float, float], std: float, prior: Float64[np.ndarray, "3"]
) -> tuple[float, float, float]:
    """Fit the logarithm of the focal length, in usual ones; returns it, its standard deviation and the cost.

    `prior` holds the deviations of that logarithm and of the principal point, `std` that of the corners.
    """
    sheet = make_sheet(sides_m)

    def deviate(state: Float64[np.ndarray, "9"]) -> Float64[np.ndarray, "11"]:
        points = Rotation.from_rotvec(state[3:6]).apply(sheet) + state[6:]
        seen = np.exp(state[0]) * points[:, :2] / points[:, 2:] + state[1:3]
        return np.append((seen - corners).ravel() / std, state[:3] / prior)

    found = least_squares(deviate, np.append(np.zeros(3), _find_pose(corners, sheet)))
    covariance = np.linalg.pinv(found.jac.T @ found.jac)
    return float(found.x[0]), float(np.sqrt(covariance[0, 0])), 2.0 * float(found.cost)


def _find_pose(corners: Corners, sheet: Float64[np.ndarray, "4 3"]) -> Float64[np.ndarray, "6"]:
    """Find the rotation vector and the place of a sheet from its homography, at the usual focal length."""
    rows = []
    for (x, y, _), (u, v) in zip(sheet, corners, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y, -u], [0, 0, 0, x, y, 1, -v * x, -v * y, -v]]
    homography = np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3)
    homography *= np.sign(homography[2, 2]) / np.linalg.norm(homography[:, 0])  # in front of the camera
    first, second, place = homography.T
    left, _, right = np.linalg.svd(np.stack([first, second, np.cross(first, second)], axis=1))
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return np.concatenate([Rotation.from_matrix(rotation).as_rotvec(), place])
