"""From one grasp and one placement to a timed motion through the six phases (paper, section 3.4).

Three runs from rest to rest: to the grasp; with the object to where it is let go, blended through the poses above; and
back. Between them the arm stands while the fingers close or open.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Pose
from schemas.trajectories import JointPath, JointVector, Motion, NoMotion, Phase
from tableverse_factory.motion.doors import Planner
from tableverse_factory.motion.handling import LINE_MARGIN_M, Handling
from tableverse_factory.motion.kinematics import solutions
from tableverse_factory.motion.recheck import recheck
from tableverse_factory.motion.runs import Run, Section, run_of
from tableverse_factory.motion.touches import Touch, spread, touches
from tableverse_factory.motion.world import Space, World
from tableverse_factory.robots.arm import Arm

MARGINS_M = (0.008, 0.003, LINE_MARGIN_M)
"""Kept from the scene between the lines; the later ones where the first cannot be had, which is recorded [m].

At the last of them, what touched the object where it stood may still touch it: it slides up along a taller neighbour.
"""
PAIRS = 4
"""Pairs of ways to take and to let go between which a path is looked for."""
RAISE_M = 0.0005
RAISES = 4
MAX_RELEASE_M = 0.02
"""A release is raised by no more than the height at which GenManip lets go [m]."""
SQUEEZE_M = 0.03
"""Fingers that hold are commanded this much closer than the object is wide: the grip has its full force there [m]."""
SETTLE_S = 0.15
"""The arm stands this long after the fingers should be closed or open [s]."""


def plan(
    world: World,
    start: JointVector,
    tcp_grasp: Pose,
    tcp_place: Pose,
    object_id: str,
    width_m: float,
    config: TrajectoriesConfig,
    rng: np.random.Generator,
    planner: Planner,
) -> Motion | NoMotion:
    """A motion that takes an object at one pose of the TCP and lets it go at another, or the first phase that fails.

    Args:
        world: Robot and scene.
        start: Where the arm is, at rest. Shape (j,) [rad].
        tcp_grasp: In the table frame.
        tcp_place: Where the fingers open, in the table frame; the placement's drop is in it.
        object_id: What is taken.
        width_m: Distance between the contacts of the grasp [m].
        config: `speed` and `step_s`.
        rng: The only source of chance.
        planner: For the paths between the lines.
    """
    if world.unseen:
        return NoMotion(Phase.PRE_GRASP, "no_shape", f"no convex piece: {', '.join(world.unseen)}")
    handling = Handling(world, object_id, tcp_grasp, tcp_place, width_m)
    ways = _ways(handling, start)
    if isinstance(ways, NoMotion):
        return ways
    handling, takes, gives = ways
    raised_m = float(handling.tcp_place.position[2] - tcp_place.position[2])
    paths = _transits(handling, start, takes, gives, rng, planner)
    if isinstance(paths, NoMotion):
        return paths
    motion = _timed(handling, paths, config)
    if isinstance(motion, NoMotion):
        return motion
    fault = recheck(world, motion, object_id, width_m, config)
    if fault is not None:
        return fault
    higher = (f"{Phase.PLACE}: released {1000 * raised_m:.1f} mm higher",) if raised_m > 0.0 else ()
    return replace(motion, fallbacks=motion.fallbacks + higher)


@dataclass(frozen=True, slots=True, eq=False)
class _Paths:
    """Everything but time.

    Attributes:
        take: How the object is taken.
        give: How it is let go.
        reaching: From the start to the pre-grasp pose. Shape (n, j) [rad].
        carrying: From the post-grasp to the pre-place pose. Shape (m, j) [rad].
        margins: Of the two [m].
    """

    take: Touch
    give: Touch
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


def _ways(handling: Handling, start: JointVector) -> tuple[Handling, Sequence[Touch], Sequence[Touch]] | NoMotion:
    """How the object can be taken and let go, and what it may touch there."""
    world = handling.world
    at_grasp = solutions(world.chain, world.in_base(handling.tcp_grasp), start, 1)
    if len(at_grasp):
        handling = handling.taken_at(at_grasp[0])
    handling = _above_touch(handling, start)
    takes = _touches(handling, start, grasp=True)
    if isinstance(takes, NoMotion):
        return takes
    gives = _touches(handling, takes[0].load.path[-1], grasp=False)
    return gives if isinstance(gives, NoMotion) else (handling, takes, gives)


def _above_touch(handling: Handling, near: JointVector) -> Handling:
    """With a release so much higher that the carried object is in nothing there, if a little is enough.

    What a placement rests on was found with true meshes; their convex pieces may be thicker by tenths of a millimetre.
    """
    world, given = handling.world, handling
    for _ in range(RAISES):
        found = solutions(world.chain, world.in_base(handling.tcp_place), near, 1)
        if not len(found):
            return given
        depth = handling.depth_at(found[0])
        if depth == 0.0:
            return handling.released_at(found[0])
        handling = handling.raised(depth + RAISE_M)
        if handling.tcp_place.position[2] - given.tcp_place.position[2] > MAX_RELEASE_M:
            return given
    return given


def _touches(handling: Handling, near: JointVector, *, grasp: bool) -> tuple[Touch, ...] | NoMotion:
    """At the grasp or at the release, at the first opening of the fingers for which there is one."""
    tcp = handling.tcp_grasp if grasp else handling.tcp_place
    made = handling.reaching if grasp else handling.leaving
    taking, giving = (Phase.GRASP, Phase.GRASP, Phase.POST_GRASP), (Phase.PLACE, Phase.POST_PLACE, Phase.PLACE)
    load = handling.carrying(LINE_MARGIN_M, resting=True)
    found: tuple[Touch, ...] | NoMotion = ()
    for opening in handling.openings():
        hand = made(opening, LINE_MARGIN_M)
        found = touches(handling.world, tcp, near, hand, load, taking if grasp else giving)
        if not isinstance(found, NoMotion) or found.reason == "out_of_reach":
            break
    return found


def _transits(
    handling: Handling,
    start: JointVector,
    takes: Sequence[Touch],
    gives: Sequence[Touch],
    rng: np.random.Generator,
    planner: Planner,
) -> _Paths | NoMotion:
    """Paths to the pre-grasp pose and from the post-grasp to the pre-place pose."""
    reached: dict[int, tuple[JointPath, float] | None] = {}
    posts, pres = (np.array([way.load.path[-1] for way in ways]) for ways in (takes, gives))
    blamed = Phase.PRE_GRASP
    for i, k in spread(posts, pres)[:PAIRS]:
        take, give = takes[i], gives[k]
        if i not in reached:
            spaces = [handling.reaching(take.opening_m, margin) for margin in MARGINS_M]
            reached[i] = _path(start, take.hand.path[-1], spaces, rng, planner)
        reaching = reached[i]
        if reaching is None:
            continue
        blamed = Phase.PRE_PLACE
        spaces = [_carrying(handling, margin) for margin in MARGINS_M]
        carrying = _path(posts[i], pres[k], spaces, rng, planner)
        if carrying is not None:
            return _Paths(take, give, reaching[0], carrying[0], (reaching[1], carrying[1]))
    return _no_path(handling, blamed, start, takes[0], gives[0])


def _carrying(handling: Handling, margin_m: float, share: float = 1.0) -> Space:
    """For a path at one of the margins, or for its blend at a share of it."""
    return handling.carrying(share * margin_m, resting=margin_m <= LINE_MARGIN_M)


def _path(
    start: JointVector, goal: JointVector, spaces: Sequence[Space], rng: np.random.Generator, planner: Planner
) -> tuple[JointPath, float] | None:
    """A path at the widest margin that allows one."""
    for space in spaces:
        if space.free(start) and space.free(goal):
            path = planner.path(start, goal, space, rng)
            if path is not None:
                return path, space.margin_m
    return None


def _no_path(handling: Handling, phase: Phase, start: JointVector, take: Touch, give: Touch) -> NoMotion:
    if phase is Phase.PRE_GRASP:
        space, ends = handling.reaching(take.opening_m, MARGINS_M[-1]), (start, take.hand.path[-1])
    else:
        space = _carrying(handling, MARGINS_M[-1])
        ends = (take.load.path[-1], give.load.path[-1])
    blocked = [why for q in ends if (why := handling.world.blocked_by(space, q))]
    if blocked:
        return NoMotion(phase, "blocked", blocked[0])
    return NoMotion(phase, "no_path", "no free joint path was found within the planner's bound")


def _timed(handling: Handling, paths: _Paths, config: TrajectoriesConfig) -> Motion | NoMotion:
    """Three runs and the two stands between them."""
    arm, dynamics, take, give = handling.world.station.arm, handling.world.dynamics, paths.take, paths.give
    line = handling.carrying(0.0, resting=True)
    plans: tuple[tuple[Phase, list[Section]], ...] = (
        (
            Phase.GRASP,
            [
                Section(Phase.PRE_GRASP, paths.reaching, handling.reaching(take.opening_m, paths.margins[0] / 2)),
                Section(Phase.GRASP, take.hand.path[::-1], handling.reaching(take.opening_m, 0.0)),
            ],
        ),
        (
            Phase.PLACE,
            [
                Section(Phase.POST_GRASP, take.load.path, line),
                Section(Phase.PRE_PLACE, paths.carrying, _carrying(handling, paths.margins[1], 0.5)),
                Section(Phase.PLACE, give.load.path[::-1], line),
            ],
        ),
        (Phase.POST_PLACE, [Section(Phase.POST_PLACE, give.hand.path, handling.leaving(give.opening_m, 0.0))]),
    )
    runs: list[Run] = []
    for index, (phase, sections) in enumerate(plans):
        dynamics.carry(handling.world.station, handling.carried if index == 1 else None)
        run = run_of(
            sections, arm, dynamics, config.speed, config.step_s, touch_at_start=index > 0, touch_at_end=index < 2
        )
        if run is None:
            return NoMotion(phase, "too_fast", "no blend of the path is free and within the limits")
        runs.append(run)
    return _motion(runs, paths, handling.width_m, arm, config.step_s)


def _motion(runs: Sequence[Run], paths: _Paths, width_m: float, arm: Arm, step_s: float) -> Motion:
    """Samples of all runs, with the stands in which the fingers close and open."""
    hold = max(0.0, width_m - SQUEEZE_M)
    opened, released = paths.take.opening_m, paths.give.opening_m
    closing = _fingers(opened, hold, arm, step_s)
    opening = _fingers(hold, released, arm, step_s)
    first, second, third = (run.timed for run in runs)
    stands = [
        np.repeat(first.positions[-1:], len(closing), axis=0),
        np.repeat(second.positions[-1:], len(opening), axis=0),
    ]
    order = list(Phase)
    return Motion(
        step_s,
        np.concatenate([first.positions, stands[0], second.positions[1:], stands[1], third.positions[1:]]),
        np.concatenate(
            [
                first.velocities,
                np.zeros_like(stands[0]),
                second.velocities[1:],
                np.zeros_like(stands[1]),
                third.velocities[1:],
            ]
        ),
        np.concatenate(
            [
                np.full(len(first.positions), opened),
                closing,
                np.full(len(second.positions) - 1, hold),
                opening,
                np.full(len(third.positions) - 1, released),
            ]
        ),
        np.concatenate(
            [
                runs[0].phases,
                np.full(len(closing), order.index(Phase.GRASP), dtype=np.int32),
                runs[1].phases[1:],
                np.full(len(opening), order.index(Phase.PLACE), dtype=np.int32),
                runs[2].phases[1:],
            ]
        ),
        paths.fallbacks(),
    )


def _fingers(start_m: float, end_m: float, arm: Arm, step_s: float) -> np.ndarray:
    """Openings from one to another at the fingers' speed, then a stand. Shape (t,) [m]."""
    moving = max(int(np.ceil(abs(end_m - start_m) / (arm.max_opening_speed * step_s))), 1)
    ramp = start_m + (end_m - start_m) * np.arange(1, moving + 1) / moving
    return np.concatenate([ramp, np.full(int(np.ceil(SETTLE_S / step_s)), end_m)])
