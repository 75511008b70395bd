"""Assembly of joint paths into a timed motion: three runs, and two pauses in which the fingers move."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Frozen
from schemas.trajectories import JointPath, Motion, NoMotion, Numbers, Phase
from tableverse_factory.robotics.motion.approach_configs import ApproachConfig
from tableverse_factory.robotics.motion.pick_place import LINE_MARGIN_M, PickPlace
from tableverse_factory.robotics.motion.retime import TimedCurve
from tableverse_factory.robotics.motion.segments import PathSegment, time_segments
from tableverse_factory.robotics.robots.arm import Arm

# Clearances kept from the scene between the lines; later ones are fallbacks, which are recorded [m]
MARGINS_M = (0.008, 0.003, LINE_MARGIN_M)
SQUEEZE_M = 0.03  # holding fingers are commanded this much closer than the object's width, for the full grip force [m]
SETTLE_S = 0.15  # pause after the fingers should be closed or open [s]
_PHASES = list(Phase)


@dataclass(frozen=True, slots=True, eq=False)
class MotionPaths(Frozen):
    """Joint paths [rad] of a motion, without time, between the lines of the grasp and of the release."""

    take: ApproachConfig
    give: ApproachConfig
    reaching: JointPath  # from the start to the pre-grasp pose
    carrying: JointPath  # from the post-grasp to the pre-place pose
    margins: tuple[float, float]  # clearances of the two [m]

    def list_fallbacks(self) -> tuple[str, ...]:
        """List shortened lines and reduced margins, in words."""
        phases = (Phase.PRE_GRASP, Phase.PRE_PLACE)
        margins = tuple(
            f"{phase}: margin {1000 * margin:g} mm"
            for phase, margin in zip(phases, self.margins, strict=True)
            if margin < MARGINS_M[0]
        )
        taken = self.take.list_fallbacks(Phase.PRE_GRASP, Phase.POST_GRASP)
        return taken + self.give.list_fallbacks(Phase.POST_PLACE, Phase.PRE_PLACE) + margins


def assemble_motion(task: PickPlace, paths: MotionPaths, config: TrajectoriesConfig) -> Motion | NoMotion:
    """Time three runs and concatenate them with the two pauses between them."""
    world, take, give = task.world, paths.take, paths.give
    plans = (
        (
            PathSegment(Phase.PRE_GRASP, paths.reaching, task.reaching_space(take.opening_m, paths.margins[0] / 2)),
            PathSegment(Phase.GRASP, take.hand.path[::-1], task.reaching_space(take.opening_m, 0.0)),
        ),
        (
            PathSegment(Phase.POST_GRASP, take.load.path, task.holding_space(0.0, task.taken)),
            PathSegment(Phase.PRE_PLACE, paths.carrying, task.holding_space(paths.margins[1] / 2)),
            PathSegment(Phase.PLACE, give.load.path[::-1], task.holding_space(0.0, task.released)),
        ),
        (PathSegment(Phase.POST_PLACE, give.hand.path, task.leaving_space(give.opening_m, 0.0)),),
    )
    runs: list[tuple[TimedCurve, np.ndarray]] = []
    for index, sections in enumerate(plans):
        world.dynamics.set_payload(world.station, task.carried if index == 1 else None)
        run = time_segments(sections, config, touch_at_start=index > 0, touch_at_end=index < 2)
        if isinstance(run, NoMotion):
            return run
        runs.append(run)
    return _concatenate_runs(runs, paths, task.width_m, world.station.arm, config.step_s)


def _concatenate_runs(
    runs: Sequence[tuple[TimedCurve, np.ndarray]], paths: MotionPaths, width_m: float, arm: Arm, step_s: float
) -> Motion:
    hold = max(0.0, width_m - SQUEEZE_M)
    opened, released = paths.take.opening_m, paths.give.opening_m
    closing, opening = _ramp_opening(opened, hold, arm, step_s), _ramp_opening(hold, released, arm, step_s)
    (first, reaching), (second, carrying), (third, leaving) = runs
    parts = (
        (first.positions, first.velocities, np.full(len(first.positions), opened), reaching),
        _hold_still(first.positions[-1:], closing, Phase.GRASP),
        (second.positions[1:], second.velocities[1:], np.full(len(second.positions) - 1, hold), carrying[1:]),
        _hold_still(second.positions[-1:], opening, Phase.PLACE),
        (third.positions[1:], third.velocities[1:], np.full(len(third.positions) - 1, released), leaving[1:]),
    )
    positions, velocities, openings, phases = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Motion(step_s, positions, velocities, openings, phases.astype(np.int32), paths.list_fallbacks())


def _hold_still(q: JointPath, openings: Numbers, phase: Phase) -> tuple[JointPath, JointPath, Numbers, np.ndarray]:
    """Repeat a configuration while the fingers move. Shape of `q`: (1, j) [rad]."""
    positions = np.repeat(q, len(openings), axis=0)
    return positions, np.zeros_like(positions), openings, np.full(len(openings), _PHASES.index(phase))


def _ramp_opening(start_m: float, end_m: float, arm: Arm, step_s: float) -> np.ndarray:
    """Move between openings at the fingers' speed, then pause. Shape (t,) [m]."""
    moving = max(int(np.ceil(abs(end_m - start_m) / (arm.max_opening_speed * step_s))), 1)
    ramp = start_m + (end_m - start_m) * np.arange(1, moving + 1) / moving
    return np.concatenate([ramp, np.full(int(np.ceil(SETTLE_S / step_s)), end_m)])
