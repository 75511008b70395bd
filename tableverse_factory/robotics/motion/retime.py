"""Time-optimal path parameterization under velocity, acceleration and torque limits (TOPP-RA).

Pham and Pham, "A new approach to time-optimal path parameterization based on reachability analysis" (T-RO 2018), in the
authors' package `toppra`.
"""

import logging
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import BSpline

from schemas.geometry import Frozen
from schemas.trajectories import JointPath, JointVector
from tableverse_factory.core.deferred_modules import defer_modules
from tableverse_factory.robotics.motion.dynamics import ArmDynamics
from tableverse_factory.robotics.robots.arm import Arm

with defer_modules("matplotlib", "matplotlib.pyplot"):  # toppra's plots: half a second, and we draw none
    from toppra.algorithm import TOPPRA
    from toppra.constraint import (
        DiscretizationType,
        JointAccelerationConstraint,
        JointTorqueConstraint,
        JointVelocityConstraint,
    )
    from toppra.interpolator import AbstractGeometricPath

logging.getLogger("toppra").setLevel(logging.ERROR)

TORQUE_SHARE = 0.9  # share of the drives' torque available to planning; the remainder is for tracking
POINTS_PER_KNOT, MIN_POINTS = 3, 60
_LIMIT_SHARE = 0.98
Marks = Float64[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class TimedCurve(Frozen):
    """Curve sampled at a constant step, at rest at both ends."""

    positions: JointPath  # [rad]
    velocities: JointPath  # [rad/s]
    places: Float64[np.ndarray, " t"]  # parameter of the curve at each sample


class _SplinePath(AbstractGeometricPath):  # type: ignore[misc]
    """Spline in toppra's path interface."""

    def __init__(self, curve: BSpline) -> None:
        self._parts = (curve, curve.derivative(1), curve.derivative(2))

    def __call__(self, path_positions: np.ndarray, order: int = 0) -> np.ndarray:
        return self._parts[order](path_positions)

    @property
    def dof(self) -> int:
        return int(self._parts[0].c.shape[1])

    @property
    def path_interval(self) -> np.ndarray:
        knots = self._parts[0].t
        return np.array([knots[0], knots[-1]])


def retime_curve(curve: BSpline, arm: Arm, dynamics: ArmDynamics, speed: float, step_s: float) -> TimedCurve | None:
    """Sample the fastest motion along a twice differentiable curve [rad] that holds all limits; None if there is none.

    `speed` is the usable share of the arm's velocity and acceleration. The motion is stretched to whole steps of
    `step_s`.
    """
    path, grid = _SplinePath(curve), _choose_gridpoints(curve)
    velocity, acceleration = speed * _LIMIT_SHARE * arm.max_velocity, speed * _LIMIT_SHARE * arm.max_acceleration
    torque = TORQUE_SHARE * arm.max_torque
    limits = [
        JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
        JointAccelerationConstraint(
            np.stack([-acceleration, acceleration], axis=1), discretization_scheme=DiscretizationType.Interpolation
        ),
        JointTorqueConstraint(
            dynamics.compute_torques,
            np.stack([-torque, torque], axis=1),
            np.zeros(len(torque)),
            DiscretizationType.Collocation,
        ),
    ]
    _, rates, _ = TOPPRA(limits, path, gridpoints=grid, solver_wrapper="seidel").compute_parameterization(0.0, 0.0)
    if rates is None or not np.isfinite(rates).all() or (rates[1:] + rates[:-1] <= 0.0).any():
        return None
    stretch = _compute_stretch(path, grid, rates, speed * arm.max_velocity, speed * arm.max_acceleration)
    return _sample_motion(path, grid, rates, stretch, step_s)


def _choose_gridpoints(curve: BSpline) -> Marks:
    """Choose where limits are checked: a few points per piece, more at the slow ends."""
    breaks = np.unique(curve.t)
    per_piece = max(POINTS_PER_KNOT, int(np.ceil(MIN_POINTS / (len(breaks) - 1))))
    inner = np.interp(np.arange((len(breaks) - 1) * per_piece + 1) / per_piece, np.arange(len(breaks)), breaks)
    first, last = inner[1] - inner[0], inner[-1] - inner[-2]
    shares = np.array([1 / 64, 1 / 16, 1 / 4])
    return np.concatenate(
        [inner[:1], inner[0] + first * shares, inner[1:-1], inner[-1] - last * shares[::-1], inner[-1:]]
    )


def _sample_motion(path: _SplinePath, grid: Marks, rates: Marks, stretch: float, step_s: float) -> TimedCurve:
    """Sample the motion that passes the grid at these rates, each piece at a constant rate of change."""
    mean = (rates[1:] + rates[:-1]) / 2
    times = np.concatenate([[0.0], np.cumsum(np.diff(grid) / mean)])
    count = int(np.ceil(times[-1] / step_s * stretch - 1e-9))
    scale = times[-1] / (count * step_s)
    at = np.arange(count + 1) * step_s * scale
    piece = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(mean) - 1)
    change = (rates[1:] - rates[:-1]) / np.diff(times)
    since = at - times[piece]
    places = grid[piece] + rates[piece] * since + 0.5 * change[piece] * since**2
    places[0], places[-1] = grid[0], grid[-1]
    rate = rates[piece] + change[piece] * since
    velocities = path(places, 1) * (rate * scale)[:, None]
    velocities[[0, -1]] = 0.0
    return TimedCurve(path(places), velocities, places)


def _compute_stretch(
    path: _SplinePath, grid: Marks, rates: Marks, max_velocity: JointVector, max_acceleration: JointVector
) -> float:
    """Compute the stretch needed for violations between the grid's points; 1 without any."""
    share = np.linspace(0.0, 1.0, 5)
    change = (rates[1:] ** 2 - rates[:-1] ** 2) / (2 * np.diff(grid))
    places = (grid[:-1, None] + np.diff(grid)[:, None] * share).ravel()
    squares = (rates[:-1, None] ** 2 + (rates[1:, None] ** 2 - rates[:-1, None] ** 2) * share).ravel()
    first, second = path(places, 1), path(places, 2)
    velocity = np.abs(first) * np.sqrt(squares)[:, None] / max_velocity
    acceleration = np.abs(second * squares[:, None] + first * np.repeat(change, len(share))[:, None]) / max_acceleration
    return max(1.0, float(velocity.max()), float(np.sqrt(acceleration.max())))
