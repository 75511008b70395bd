"""From corners to a smooth curve: velocity and acceleration are continuous, straight parts stay straight.

The curve is Schoenberg's variation-diminishing cubic spline of the polyline: its coefficients are the polyline at the
Greville points of its knots. It reproduces straight lines exactly, never overshoots, keeps both ends, and leaves the
polyline at a corner over about two knots only. So the distance between the knots is the radius of the blend: wide in
open space, and fine where something is touched, where the line of the TCP has to be kept.
"""

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import BSpline

from schemas.trajectories import JointPath

FINE_RAD = 0.01
"""Knots at a touch are this far apart, measured along the path."""
GROWTH = 0.25
"""Their distance grows by this share of the distance from the touch."""
_DEGREE = 3


def path_marks(path: JointPath) -> Float64[np.ndarray, " n"]:
    """Length of the polyline up to each of its points [rad]. Shape (n,)."""
    lengths: Float64[np.ndarray, " n"] = np.sqrt((np.diff(path, axis=0) ** 2).sum(axis=1))
    return np.concatenate([[0.0], np.cumsum(lengths)])


def blended(path: JointPath, radius_rad: float, *, touch_at_start: bool, touch_at_end: bool) -> BSpline:
    """A curve along a polyline, whose parameter is about the length along it [rad].

    Args:
        path: Corners; neighbours differ. Shape (n, j) [rad].
        radius_rad: Distance between the knots in open space, and so the size of a blend [rad].
        touch_at_start: Whether the gripper or what it carries touches something at the start.
        touch_at_end: The same at the end.
    """
    marks = path_marks(path)
    breaks = _breaks(float(marks[-1]), radius_rad, touch_at_start, touch_at_end)
    knots = np.concatenate([np.repeat(breaks[0], _DEGREE), breaks, np.repeat(breaks[-1], _DEGREE)])
    greville = np.array([knots[k + 1 : k + 1 + _DEGREE].mean() for k in range(len(knots) - _DEGREE - 1)])
    coefficients = np.stack([np.interp(greville, marks, column) for column in path.T], axis=1)
    return BSpline(knots, coefficients, _DEGREE)


def _breaks(length: float, radius: float, at_start: bool, at_end: bool) -> Float64[np.ndarray, " n"]:
    """Where one cubic ends and the next begins: their density is that of the wanted distances."""
    fine = np.linspace(0.0, length, max(int(np.ceil(length / FINE_RAD)) * 4, 16))
    away = np.full(len(fine), np.inf)
    away = np.minimum(away, fine if at_start else np.inf)
    away = np.minimum(away, length - fine if at_end else np.inf)
    density = 1.0 / np.clip(GROWTH * away, min(FINE_RAD, radius), radius)
    total = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(fine))])
    count = max(int(np.ceil(total[-1])), 4)
    breaks: Float64[np.ndarray, " n"] = np.interp(np.linspace(0.0, total[-1], count + 1), total, fine)
    breaks[0], breaks[-1] = 0.0, length
    return breaks
