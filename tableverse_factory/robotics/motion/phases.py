"""Pick-and-place planning: from a grasp and a placement to a timed motion through six phases (paper, section 3.4).

Three runs from rest to rest: to the grasp; with the object to its release, blended through the poses above; and back.
Between them the arm pauses while the fingers close or open.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Pose
from schemas.trajectories import JointPath, JointVector, Motion, NoMotion, Phase
from tableverse_factory.geometry.math.transforms import translate_pose
from tableverse_factory.robotics.motion.approach_configs import ApproachConfig, find_approach_configs, rank_pairs
from tableverse_factory.robotics.motion.assembly import MARGINS_M, MotionPaths, assemble_motion
from tableverse_factory.robotics.motion.interfaces import Planner
from tableverse_factory.robotics.motion.kinematics import solve_ik
from tableverse_factory.robotics.motion.pick_place import LINE_MARGIN_M, PickPlace
from tableverse_factory.robotics.motion.validate import validate_motion
from tableverse_factory.robotics.motion.world import CollisionSpace, CollisionWorld

MAX_PAIRS = 4  # pairs of grasp and release configurations between which a path is searched
RAISE_M = 0.0005
MAX_RAISES = 4
MAX_RELEASE_M = 0.02  # maximum raise of a release: the height at which GenManip lets go [m]


def plan_motion(
    world: CollisionWorld,
    start: JointVector,
    tcp_grasp: Pose,
    tcp_place: Pose,
    object_id: str,
    width_m: float,
    config: TrajectoriesConfig,
    rng: np.random.Generator,
    planner: Planner,
) -> Motion | NoMotion:
    """Plan a motion that grasps an object at one TCP pose and releases it at another, or return the first failed phase.

    It starts from rest. Poses are in the table frame; `tcp_place`, where the fingers open, includes the placement's
    drop. `width_m` is the distance between the contacts of the grasp, `rng` the only source of randomness.
    """
    if world.unseen:
        return NoMotion(Phase.PRE_GRASP, "no_shape", f"no convex piece: {', '.join(world.unseen)}")
    task = PickPlace(world, object_id, tcp_grasp, tcp_place, width_m)
    ways = _find_approaches(task, start)
    if isinstance(ways, NoMotion):
        return ways
    task, takes, gives = ways
    paths = _plan_transits(task, start, takes, gives, rng, planner)
    motion = paths if isinstance(paths, NoMotion) else assemble_motion(task, paths, config)
    fault = motion if isinstance(motion, NoMotion) else validate_motion(world, motion, object_id, width_m, config)
    if isinstance(motion, NoMotion) or fault is not None:
        return fault or motion
    raised_m = float(task.tcp_place.position[2] - tcp_place.position[2])
    higher = (f"{Phase.PLACE}: released {1000 * raised_m:.1f} mm higher",) if raised_m > 0.0 else ()
    return replace(motion, fallbacks=motion.fallbacks + higher + planner.list_fallbacks(world))


def _find_approaches(
    task: PickPlace, start: JointVector
) -> tuple[PickPlace, Sequence[ApproachConfig], Sequence[ApproachConfig]] | NoMotion:
    """Find grasp and release configurations, and record the contacts allowed there."""
    world = task.world
    at_grasp = solve_ik(world.chain, world.in_base(task.tcp_grasp), start, 1)
    if len(at_grasp):
        task = task.allow_grasp_contacts(at_grasp[0])
    task = _raise_release(task, start)
    takes = _find_approach(task, start, grasp=True)
    if isinstance(takes, NoMotion):
        return takes
    gives = _find_approach(task, takes[0].load.path[-1], grasp=False)
    return gives if isinstance(gives, NoMotion) else (task, takes, gives)


def _raise_release(task: PickPlace, near: JointVector) -> PickPlace:
    """Raise the release slightly if the carried object would penetrate something there.

    Placements are found with true meshes; their convex pieces may be thicker by tenths of a millimeter.
    """
    world, given = task.world, task
    for _ in range(MAX_RAISES):
        found = solve_ik(world.chain, world.in_base(task.tcp_place), near, 1)
        if not len(found):
            return given
        depth = task.compute_depth_at(found[0])
        if depth == 0.0:
            return task.allow_release_contacts(found[0])
        task = replace(task, tcp_place=translate_pose(task.tcp_place, np.array([0.0, 0.0, depth + RAISE_M])))
        if task.tcp_place.position[2] - given.tcp_place.position[2] > MAX_RELEASE_M:
            return given
    return given


def _find_approach(task: PickPlace, near: JointVector, *, grasp: bool) -> tuple[ApproachConfig, ...] | NoMotion:
    """Find configurations at the grasp or release, at the first opening of the fingers that has any."""
    tcp = task.tcp_grasp if grasp else task.tcp_place
    made = task.reaching_space if grasp else task.leaving_space
    taking, giving = (Phase.GRASP, Phase.GRASP, Phase.POST_GRASP), (Phase.PLACE, Phase.POST_PLACE, Phase.PLACE)
    load = task.holding_space(LINE_MARGIN_M, task.taken if grasp else task.released)
    found: tuple[ApproachConfig, ...] | NoMotion = ()
    for opening in task.openings():
        hand = made(opening, LINE_MARGIN_M)
        found = find_approach_configs(tcp, near, hand, load, taking if grasp else giving)
        if not isinstance(found, NoMotion) or found.reason == "out_of_reach":
            break
    return found


def _plan_transits(
    task: PickPlace,
    start: JointVector,
    takes: Sequence[ApproachConfig],
    gives: Sequence[ApproachConfig],
    rng: np.random.Generator,
    planner: Planner,
) -> MotionPaths | NoMotion:
    """Plan paths to the pre-grasp pose and from the post-grasp to the pre-place pose."""
    reached: dict[int, tuple[JointPath, float] | None] = {}
    posts, pres = (np.array([way.load.path[-1] for way in ways]) for ways in (takes, gives))
    blamed = Phase.PRE_GRASP
    for i, k in rank_pairs(posts, pres)[:MAX_PAIRS]:
        take, give = takes[i], gives[k]
        if i not in reached:
            spaces = [task.reaching_space(take.opening_m, margin) for margin in MARGINS_M]
            reached[i] = _plan_with_margins(start, take.hand.path[-1], spaces, rng, planner)
        reaching = reached[i]
        if reaching is None:
            continue
        blamed = Phase.PRE_PLACE
        spaces = [task.holding_space(margin) for margin in MARGINS_M]
        carrying = _plan_with_margins(posts[i], pres[k], spaces, rng, planner)
        if carrying is not None:
            return MotionPaths(take, give, reaching[0], carrying[0], (reaching[1], carrying[1]))
    return _explain_no_path(task, blamed, start, takes[0], gives[0])


def _plan_with_margins(
    start: JointVector, goal: JointVector, spaces: Sequence[CollisionSpace], rng: np.random.Generator, planner: Planner
) -> tuple[JointPath, float] | None:
    """Plan a path at the widest margin that allows one."""
    for space in spaces:
        if space.is_free(start) and space.is_free(goal):
            path = planner.plan_path(start, goal, space, rng)
            if path is not None:
                return path, space.margin_m
    return None


def _explain_no_path(
    task: PickPlace, phase: Phase, start: JointVector, take: ApproachConfig, give: ApproachConfig
) -> NoMotion:
    if phase is Phase.PRE_GRASP:
        space, ends = task.reaching_space(take.opening_m, MARGINS_M[-1]), (start, take.hand.path[-1])
    else:
        space = task.holding_space(MARGINS_M[-1])
        ends = (take.load.path[-1], give.load.path[-1])
    blocked = [why for q in ends if (why := task.world.describe_collision(space, q))]
    if blocked:
        return NoMotion(phase, "blocked", blocked[0])
    return NoMotion(phase, "no_path", "no free joint path was found within the planner's bound")
