"""Runs from rest to rest: joint paths joined, blended into one curve and timed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int32
from scipy.interpolate import BSpline

from schemas.config import TrajectoriesConfig
from schemas.geometry import Frozen
from schemas.trajectories import JointPath, NoMotion, Phase
from tableverse_factory.robotics.motion.retime import TimedCurve, retime_curve
from tableverse_factory.robotics.motion.rrt import EDGE_STEP_RAD
from tableverse_factory.robotics.motion.world import CollisionSpace

CONTACT_SPACING_RAD = 0.01  # knot spacing at a contact, measured along the path
SPACING_GROWTH = 0.25  # growth of the knot spacing with distance from the contact
_DEGREE = 3
BLEND_RADII_RAD = (0.5, 0.25, 0.12, 0.06, 0.03, 0.015)  # blend radii, tried widest first until the curve is free


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
    away = np.minimum(fine if at_start else np.full(len(fine), np.inf), length - fine if at_end else np.inf)
    density = 1.0 / np.clip(SPACING_GROWTH * away, min(CONTACT_SPACING_RAD, radius), radius)
    total = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(fine))])
    count = max(int(np.ceil(total[-1])), 4)
    breaks: Float64[np.ndarray, " n"] = np.interp(np.linspace(0.0, total[-1], count + 1), total, fine)
    breaks[0], breaks[-1] = 0.0, length
    return breaks


@dataclass(frozen=True, slots=True, eq=False)
class PathSegment(Frozen):
    """Path of one phase within a run: corners [rad], and the space that its blended curve is checked against."""

    phase: Phase
    path: JointPath
    space: CollisionSpace


def time_segments(
    sections: Sequence[PathSegment], config: TrajectoriesConfig, *, touch_at_start: bool, touch_at_end: bool
) -> tuple[TimedCurve, Int32[np.ndarray, " t"]] | NoMotion:
    """Compute the fastest run through all segments and the index into `Phase` of each sample, or why there is none.

    A failure is attributed to the run's last phase: `no_blend` where every blend collides, `too_fast` where no timing
    of the curve keeps velocity, acceleration and torque.
    """
    world, phase, blocked = sections[0].space.world, sections[-1].phase, ""
    path, ends = _join_segments(sections)
    for radius in BLEND_RADII_RAD:
        curve = blend_path(path, radius, touch_at_start=touch_at_start, touch_at_end=touch_at_end)
        blocked = _find_collision(curve, sections, ends)
        if not blocked:
            timed = retime_curve(curve, world.station.arm, world.dynamics, config.speed, config.step_s)
            if timed is None:
                detail = "no timing of the path from rest to rest keeps the limits of velocity, acceleration and torque"
                return NoMotion(phase, "too_fast", detail)
            numbers = np.array([list(Phase).index(section.phase) for section in sections], dtype=np.int32)
            return timed, numbers[_find_owners(timed.places, ends)]
    return NoMotion(phase, "no_blend", f"{blocked}, with corners blended over {BLEND_RADII_RAD[-1]:g} rad")


def _join_segments(sections: Sequence[PathSegment]) -> tuple[JointPath, np.ndarray]:
    """Join all corners; also return the arc length at which each segment ends."""
    rows, counts = [sections[0].path[:1]], [1]
    for section in sections:
        distinct = np.abs(np.diff(section.path, axis=0)).max(axis=1) > 1e-9
        rows.append(section.path[1:][distinct])
        counts.append(len(rows[-1]))
    path = np.concatenate(rows)
    return path, compute_arc_lengths(path)[np.cumsum(counts)[1:] - 1]


def _find_collision(curve: BSpline, sections: Sequence[PathSegment], ends: np.ndarray) -> str:
    """Describe the curve's first collision, checked as finely as the corners were; empty where it is free."""
    steps = np.abs(np.diff(curve.c, axis=0)).max(axis=1).sum() / EDGE_STEP_RAD
    marks = np.linspace(curve.t[0], curve.t[-1], max(int(np.ceil(2 * steps)), 20))
    owner = _find_owners(marks, ends)
    for index, section in enumerate(sections):
        path: JointPath = curve(marks[owner == index])
        if (hit := section.space.find_first_collision(path)) is not None:
            return f"{section.space.world.describe_collision(section.space, path[hit])} in {section.phase}"
    return ""


def _find_owners(places: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Find the segment of each place on the curve."""
    return np.minimum(np.searchsorted(ends, places, side="left"), len(ends) - 1)
