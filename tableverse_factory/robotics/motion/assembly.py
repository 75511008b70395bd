"""From paths to a timed motion: three runs and the two stands between them in which the fingers move."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Frozen
from schemas.trajectories import JointPath, Motion, NoMotion, Numbers, Phase
from tableverse_factory.robotics.motion.approach_configs import ApproachConfig
from tableverse_factory.robotics.motion.pick_place import LINE_MARGIN_M, Handling
from tableverse_factory.robotics.motion.segments import PathSegment, TimedRun, run_of
from tableverse_factory.robotics.robots.arm import Arm

MARGINS_M = (0.008, 0.003, LINE_MARGIN_M)
"""Kept from the scene between the lines; the later ones where the first cannot be had, which is recorded [m]."""
SQUEEZE_M = 0.03
"""Fingers that hold are commanded this much closer than the object is wide: the grip has its full force there [m]."""
SETTLE_S = 0.15
"""The arm stands this long after the fingers should be closed or open [s]."""
_ORDER = list(Phase)


@dataclass(frozen=True, slots=True, eq=False)
class Paths(Frozen):
    """Everything but time.

    Attributes:
        take: How the object is taken.
        give: How it is let go.
        reaching: From the start to the pre-grasp pose. Shape (n, j) [rad].
        carrying: From the post-grasp to the pre-place pose. Shape (m, j) [rad].
        margins: Of the two [m].
    """

    take: ApproachConfig
    give: ApproachConfig
    reaching: JointPath
    carrying: JointPath
    margins: tuple[float, float]

    def fallbacks(self) -> tuple[str, ...]:
        """What was settled for."""
        phases = (Phase.PRE_GRASP, Phase.PRE_PLACE)
        margins = tuple(
            f"{phase}: margin {1000 * margin:g} mm"
            for phase, margin in zip(phases, self.margins, strict=True)
            if margin < MARGINS_M[0]
        )
        taken = self.take.fallbacks(Phase.PRE_GRASP, Phase.POST_GRASP)
        return taken + self.give.fallbacks(Phase.POST_PLACE, Phase.PRE_PLACE) + margins


def assembled(handling: Handling, paths: Paths, config: TrajectoriesConfig) -> Motion | NoMotion:
    """Three runs and the two stands between them."""
    arm, dynamics, take, give = handling.world.station.arm, handling.world.dynamics, paths.take, paths.give
    plans = (
        (
            PathSegment(Phase.PRE_GRASP, paths.reaching, handling.reaching(take.opening_m, paths.margins[0] / 2)),
            PathSegment(Phase.GRASP, take.hand.path[::-1], handling.reaching(take.opening_m, 0.0)),
        ),
        (
            PathSegment(Phase.POST_GRASP, take.load.path, handling.lifting(0.0)),
            PathSegment(Phase.PRE_PLACE, paths.carrying, handling.carrying(paths.margins[1] / 2)),
            PathSegment(Phase.PLACE, give.load.path[::-1], handling.lowering(0.0)),
        ),
        (PathSegment(Phase.POST_PLACE, give.hand.path, handling.leaving(give.opening_m, 0.0)),),
    )
    runs: list[TimedRun] = []
    for index, sections in enumerate(plans):
        dynamics.carry(handling.world.station, handling.carried if index == 1 else None)
        run = run_of(
            sections, arm, dynamics, config.speed, config.step_s, touch_at_start=index > 0, touch_at_end=index < 2
        )
        if isinstance(run, NoMotion):
            return run
        runs.append(run)
    return _motion(runs, paths, handling.width_m, arm, config.step_s)


def _motion(runs: Sequence[TimedRun], paths: Paths, width_m: float, arm: Arm, step_s: float) -> Motion:
    """Samples of all runs, with the stands in which the fingers close and open."""
    hold = max(0.0, width_m - SQUEEZE_M)
    opened, released = paths.take.opening_m, paths.give.opening_m
    closing, opening = _fingers(opened, hold, arm, step_s), _fingers(hold, released, arm, step_s)
    first, second, third = (run.timed for run in runs)
    parts = (
        (first.positions, first.velocities, np.full(len(first.positions), opened), runs[0].phases),
        _stand(first.positions[-1:], closing, Phase.GRASP),
        (second.positions[1:], second.velocities[1:], np.full(len(second.positions) - 1, hold), runs[1].phases[1:]),
        _stand(second.positions[-1:], opening, Phase.PLACE),
        (third.positions[1:], third.velocities[1:], np.full(len(third.positions) - 1, released), runs[2].phases[1:]),
    )
    positions, velocities, openings, phases = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Motion(step_s, positions, velocities, openings, phases.astype(np.int32), paths.fallbacks())


def _stand(q: JointPath, openings: Numbers, phase: Phase) -> tuple[JointPath, JointPath, Numbers, np.ndarray]:
    """Positions, velocities, openings and phases while the arm stands. Shape of `q`: (1, j) [rad]."""
    positions = np.repeat(q, len(openings), axis=0)
    return positions, np.zeros_like(positions), openings, np.full(len(openings), _ORDER.index(phase))


def _fingers(start_m: float, end_m: float, arm: Arm, step_s: float) -> np.ndarray:
    """Openings from one to another at the fingers' speed, then a stand. Shape (t,) [m]."""
    moving = max(int(np.ceil(abs(end_m - start_m) / (arm.max_opening_speed * step_s))), 1)
    ramp = start_m + (end_m - start_m) * np.arange(1, moving + 1) / moving
    return np.concatenate([ramp, np.full(int(np.ceil(SETTLE_S / step_s)), end_m)])
