"""From one grasp and one placement to a timed motion through the six phases (paper, section 3.4).

Three runs from rest to rest: to the grasp; with the object to where it is let go, blended through the poses above; and
back. Between them the arm stands while the fingers close or open.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Pose
from schemas.trajectories import JointPath, JointVector, Motion, NoMotion, Phase
from tableverse_factory.robotics.motion.approach_configs import ApproachConfig, spread, touches
from tableverse_factory.robotics.motion.assembly import MARGINS_M, Paths, assembled
from tableverse_factory.robotics.motion.interfaces import Planner
from tableverse_factory.robotics.motion.kinematics import solutions
from tableverse_factory.robotics.motion.pick_place import LINE_MARGIN_M, Handling
from tableverse_factory.robotics.motion.validate import recheck
from tableverse_factory.robotics.motion.world import Space, World

PAIRS = 4
"""Pairs of ways to take and to let go between which a path is looked for."""
RAISE_M = 0.0005
RAISES = 4
MAX_RELEASE_M = 0.02
"""A release is raised by no more than the height at which GenManip lets go [m]."""


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
    paths = _transits(handling, start, takes, gives, rng, planner)
    motion = paths if isinstance(paths, NoMotion) else assembled(handling, paths, config)
    fault = motion if isinstance(motion, NoMotion) else recheck(world, motion, object_id, width_m, config)
    if isinstance(motion, NoMotion) or fault is not None:
        return fault or motion
    raised_m = float(handling.tcp_place.position[2] - tcp_place.position[2])
    higher = (f"{Phase.PLACE}: released {1000 * raised_m:.1f} mm higher",) if raised_m > 0.0 else ()
    return replace(motion, fallbacks=motion.fallbacks + higher + planner.fallbacks(world))


def _ways(
    handling: Handling, start: JointVector
) -> tuple[Handling, Sequence[ApproachConfig], Sequence[ApproachConfig]] | NoMotion:
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


def _touches(handling: Handling, near: JointVector, *, grasp: bool) -> tuple[ApproachConfig, ...] | NoMotion:
    """At the grasp or at the release, at the first opening of the fingers for which there is one."""
    tcp = handling.tcp_grasp if grasp else handling.tcp_place
    made = handling.reaching if grasp else handling.leaving
    taking, giving = (Phase.GRASP, Phase.GRASP, Phase.POST_GRASP), (Phase.PLACE, Phase.POST_PLACE, Phase.PLACE)
    load = handling.lifting(LINE_MARGIN_M) if grasp else handling.lowering(LINE_MARGIN_M)
    found: tuple[ApproachConfig, ...] | NoMotion = ()
    for opening in handling.openings():
        hand = made(opening, LINE_MARGIN_M)
        found = touches(handling.world, tcp, near, hand, load, taking if grasp else giving)
        if not isinstance(found, NoMotion) or found.reason == "out_of_reach":
            break
    return found


def _transits(
    handling: Handling,
    start: JointVector,
    takes: Sequence[ApproachConfig],
    gives: Sequence[ApproachConfig],
    rng: np.random.Generator,
    planner: Planner,
) -> Paths | NoMotion:
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
        spaces = [handling.carrying(margin) for margin in MARGINS_M]
        carrying = _path(posts[i], pres[k], spaces, rng, planner)
        if carrying is not None:
            return Paths(take, give, reaching[0], carrying[0], (reaching[1], carrying[1]))
    return _no_path(handling, blamed, start, takes[0], gives[0])


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


def _no_path(
    handling: Handling, phase: Phase, start: JointVector, take: ApproachConfig, give: ApproachConfig
) -> NoMotion:
    if phase is Phase.PRE_GRASP:
        space, ends = handling.reaching(take.opening_m, MARGINS_M[-1]), (start, take.hand.path[-1])
    else:
        space = handling.carrying(MARGINS_M[-1])
        ends = (take.load.path[-1], give.load.path[-1])
    blocked = [why for q in ends if (why := handling.world.blocked_by(space, q))]
    if blocked:
        return NoMotion(phase, "blocked", blocked[0])
    return NoMotion(phase, "no_path", "no free joint path was found within the planner's bound")
