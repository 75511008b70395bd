"""Smooth curves from corners, with continuous velocity and acceleration; straight parts stay straight.

The curve is Schoenberg's variation-diminishing cubic spline of the polyline: its coefficients are the polyline at the
Greville points of its knots. It reproduces straight lines exactly, never overshoots, keeps both ends, and leaves the
polyline at a corner over about two knots only. So knot spacing is the blend radius: wide in open space, and fine near
contacts, where the line of the TCP has to be kept.
"""

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import BSpline

from schemas.trajectories import JointPath

CONTACT_SPACING_RAD = 0.01  # knot spacing at a contact, measured along the path
SPACING_GROWTH = 0.25  # growth of the knot spacing with distance from the contact
_DEGREE = 3


def compute_arc_lengths(path: JointPath) -> Float64[np.ndarray, " n"]:
    """Compute the polyline's length up to each of its points [rad]. Shape (n,)."""
    lengths: Float64[np.ndarray, " n"] = np.sqrt((np.diff(path, axis=0) ** 2).sum(axis=1))
    return np.concatenate([[0.0], np.cumsum(lengths)])


def blend_path(path: JointPath, radius_rad: float, *, touch_at_start: bool, touch_at_end: bool) -> BSpline:
    """Blend a polyline into a curve whose parameter is about the length along it [rad].

    Knots are `radius_rad` apart in open space, finer at ends where the gripper or its object touches something.
    """
    marks = compute_arc_lengths(path)
    breaks = _place_breaks(float(marks[-1]), radius_rad, touch_at_start, touch_at_end)
    knots = np.concatenate([np.repeat(breaks[0], _DEGREE), breaks, np.repeat(breaks[-1], _DEGREE)])
    greville = np.array([knots[k + 1 : k + 1 + _DEGREE].mean() for k in range(len(knots) - _DEGREE - 1)])
    coefficients = np.stack([np.interp(greville, marks, column) for column in path.T], axis=1)
    return BSpline(knots, coefficients, _DEGREE)


def _place_breaks(length: float, radius: float, at_start: bool, at_end: bool) -> Float64[np.ndarray, " n"]:
    """Place breaks between cubics at a density that gives the wanted spacing."""
    fine = np.linspace(0.0, length, max(int(np.ceil(length / CONTACT_SPACING_RAD)) * 4, 16))
    away = np.full(len(fine), np.inf)
    away = np.minimum(away, fine if at_start else np.inf)
    away = np.minimum(away, length - fine if at_end else np.inf)
    density = 1.0 / np.clip(SPACING_GROWTH * away, min(CONTACT_SPACING_RAD, radius), radius)
    total = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(fine))])
    count = max(int(np.ceil(total[-1])), 4)
    breaks: Float64[np.ndarray, " n"] = np.interp(np.linspace(0.0, total[-1], count + 1), total, fine)
    breaks[0], breaks[-1] = 0.0, length
    return breaks
