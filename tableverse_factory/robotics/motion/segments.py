"""A run from rest to rest: joint paths one after the other, blended into one curve and timed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int32
from scipy.interpolate import BSpline

from schemas.geometry import Frozen
from schemas.trajectories import JointPath, NoMotion, Phase
from tableverse_factory.robotics.motion.blend import blended, path_marks
from tableverse_factory.robotics.motion.dynamics import Dynamics
from tableverse_factory.robotics.motion.retime import Timed, retimed
from tableverse_factory.robotics.motion.rrt import EDGE_STEP_RAD
from tableverse_factory.robotics.motion.world import Space
from tableverse_factory.robotics.robots.arm import Arm

RADII_RAD = (0.5, 0.25, 0.12, 0.06, 0.03, 0.015)
"""Blends that are tried, widest first, until the curve is free."""


@dataclass(frozen=True, slots=True, eq=False)
class PathSegment(Frozen):
    """Part of a run.

    Attributes:
        phase: It belongs to.
        path: Corners with both ends; the next section starts where it ends. Shape (n, j) [rad].
        space: What the blended curve is checked against.
    """

    phase: Phase
    path: JointPath
    space: Space


@dataclass(frozen=True, slots=True, eq=False)
class TimedRun(Frozen):
    """A timed run.

    Attributes:
        timed: Its samples.
        phases: Index into `Phase` of each. Shape (t,).
    """

    timed: Timed
    phases: Int32[np.ndarray, " t"]


def run_of(
    sections: Sequence[PathSegment],
    arm: Arm,
    dynamics: Dynamics,
    speed: float,
    step_s: float,
    *,
    touch_at_start: bool,
    touch_at_end: bool,
) -> TimedRun | NoMotion:
    """The fastest run through all sections without a stop between them, or why there is none.

    A failure is that of the phase in which the run ends: `no_blend` where something is in the way of every blend,
    `too_fast` where no timing of the curve keeps velocity, acceleration and torque.
    """
    path, ends = _joined(sections)
    phase, blocked = sections[-1].phase, ""
    for radius in RADII_RAD:
        curve = blended(path, radius, touch_at_start=touch_at_start, touch_at_end=touch_at_end)
        blocked = _blocked(curve, sections, ends)
        if not blocked:
            timed = retimed(curve, arm, dynamics, speed, step_s)
            if timed is None:
                detail = "no timing of the path from rest to rest keeps the limits of velocity, acceleration and torque"
                return NoMotion(phase, "too_fast", detail)
            return TimedRun(timed, _phases(timed, sections, ends))
    return NoMotion(phase, "no_blend", f"{blocked}, with corners blended over {RADII_RAD[-1]:g} rad")


def _joined(sections: Sequence[PathSegment]) -> tuple[JointPath, np.ndarray]:
    """All corners once, and the mark at which each section ends."""
    rows, counts = [sections[0].path[:1]], [1]
    for section in sections:
        distinct = np.abs(np.diff(section.path, axis=0)).max(axis=1) > 1e-9
        rows.append(section.path[1:][distinct])
        counts.append(len(rows[-1]))
    path = np.concatenate(rows)
    return path, path_marks(path)[np.cumsum(counts)[1:] - 1]


def _blocked(curve: BSpline, sections: Sequence[PathSegment], ends: np.ndarray) -> str:
    """What is in the way of the curve, looked at as closely as the corners were; empty where it is free."""
    steps = np.abs(np.diff(curve.c, axis=0)).max(axis=1).sum() / EDGE_STEP_RAD
    marks = np.linspace(curve.t[0], curve.t[-1], max(int(np.ceil(2 * steps)), 20))
    owner = np.minimum(np.searchsorted(ends, marks, side="left"), len(sections) - 1)
    for index, section in enumerate(sections):
        path: JointPath = curve(marks[owner == index])
        hit = section.space.first_hit(path)
        if hit is not None:
            return f"{section.space.world.blocked_by(section.space, path[hit])} in {section.phase}"
    return ""


def _phases(timed: Timed, sections: Sequence[PathSegment], ends: np.ndarray) -> Int32[np.ndarray, " t"]:
    order = list(Phase)
    numbers = np.array([order.index(section.phase) for section in sections], dtype=np.int32)
    return numbers[np.minimum(np.searchsorted(ends, timed.places, side="left"), len(sections) - 1)]
