"""Grasp and release configurations, each with the two straight lines that lead away from it.

Grasping and releasing mirror each other: one line with empty open fingers, back along the approach, and one with the
object, straight up.
"""

from dataclasses import dataclass

import numpy as np

from schemas.geometry import Frozen, Pose, Vector3
from schemas.trajectories import JointPath, JointVector, NoMotion, Phase
from tableverse_factory.geometry.math.transforms import rotation_matrix, translate_pose
from tableverse_factory.robotics.motion.kinematics import Configurations, follow_poses, solve_ik
from tableverse_factory.robotics.motion.world import CollisionSpace
from tableverse_factory.robotics.robots.gripper_clearance import LIFT_M, STANDOFF_M

SPACING_M = 0.005  # distance between solved poses; between them the TCP strays by hundredths of a millimeter
MAX_BRANCHES = 6  # IK solutions tried per TCP pose
MIN_LINE_SHARE = 0.4  # A line that ends early is accepted, and recorded, if at least this share of it is left
SLANT_RAD = 0.26  # lean of the lines that are tried where an obstacle hangs over the way up
_UP = np.array([0.0, 0.0, 1.0])
_SLANTED = [
    np.array([np.sin(SLANT_RAD) * np.cos(side), np.sin(SLANT_RAD) * np.sin(side), np.cos(SLANT_RAD)])
    for side in np.arange(6) * np.pi / 3
]


@dataclass(frozen=True, slots=True, eq=False)
class CartesianLine(Frozen):
    """Configurations along a straight motion of the TCP at constant orientation."""

    path: JointPath  # from the contact end to the free end [rad]
    length_m: float  # reached; less than requested where the arm or the scene ends it
    blocked_by: str  # what ended it; empty for full length


def trace_lines(
    space: CollisionSpace, touching: Configurations, tcp: Pose, direction: Vector3, length_m: float
) -> list[CartesianLine]:
    """Trace a line along a unit vector of the table frame from each configuration at `tcp`, as far as it is free."""
    world = space.world
    count = int(np.ceil(length_m / SPACING_M - 1e-9))
    away = [translate_pose(tcp, np.asarray(direction) * (length_m * k / count)) for k in range(1, count + 1)]
    rows, reached = follow_poses(world.chain, touching, [world.in_base(pose) for pose in away])
    found = []
    for branch, steps in enumerate(reached.tolist()):
        path = np.concatenate([touching[branch][None], rows[:steps, branch]])
        why = "" if steps == count else "the arm's reach"
        if (hit := space.find_first_collision(path)) is not None:
            why, steps = world.describe_collision(space, path[hit]), hit - 1
        found.append(CartesianLine(path[: steps + 1], length_m * max(steps, 0) / count, why))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class ApproachConfig(Frozen):
    """Configuration at a grasp or release."""

    opening_m: float  # distance between the open fingers
    hand: CartesianLine  # with empty fingers, from here back along the approach
    load: CartesianLine  # with the object, from here upwards
    slanted: bool  # whether `load` leans to one side

    def list_fallbacks(self, hand: Phase, load: Phase) -> tuple[str, ...]:
        """List lines that are shorter than usual or slanted, in words."""
        found = ((hand, self.hand, STANDOFF_M), (load, self.load, LIFT_M))
        short = tuple(
            f"{phase}: {line.length_m:.3f} m" for phase, line, usual in found if line.length_m < 0.999 * usual
        )
        return (*short, f"{load}: slanted") if self.slanted else short


def find_approach_configs(
    tcp: Pose, near: JointVector, hand: CollisionSpace, load: CollisionSpace, phases: tuple[Phase, Phase, Phase]
) -> tuple[ApproachConfig, ...] | NoMotion:
    """Find configurations at a TCP pose in the table frame with both lines free: full lines first, then by nearness.

    `hand` and `load` define free space with empty fingers and with the object. `phases` are blamed for failures of the
    pose itself, of the hand's line and of the load's line.
    """
    world = hand.world
    found = solve_ik(world.chain, world.in_base(tcp), near, MAX_BRANCHES)
    if not len(found):
        x, y, z = tcp.position
        return NoMotion(phases[0], "out_of_reach", f"no configuration has the gripper at ({x:.3f}, {y:.3f}, {z:.3f}) m")
    clear = np.array([hand.is_free(q) and load.is_free(q) for q in found])
    if not clear.any():
        nearest = min(found, key=lambda q: max(world.compute_depth(hand, q), world.compute_depth(load, q)))
        why = world.describe_collision(hand, nearest) or world.describe_collision(load, nearest)
        return NoMotion(phases[0], "blocked", why)
    back = -rotation_matrix(tcp.quaternion_wxyz)[:, 2]
    hands = trace_lines(hand, found[clear], tcp, back, STANDOFF_M)
    chosen = [k for k, line in enumerate(hands) if line.length_m >= MIN_LINE_SHARE * STANDOFF_M]
    if not chosen:
        return _explain_short_line(phases[1], hands)
    straight: list[CartesianLine] = []
    for direction in (_UP, *_SLANTED):
        loads = trace_lines(load, found[clear][chosen], tcp, direction, LIFT_M)
        straight = straight or loads
        ways = [
            ApproachConfig(hand.opening_m, hands[k], line, direction is not _UP)
            for k, line in zip(chosen, loads, strict=True)
            if line.length_m >= MIN_LINE_SHARE * LIFT_M
        ]
        if ways:
            return tuple(sorted(ways, key=lambda way: bool(way.list_fallbacks(Phase.GRASP, Phase.GRASP))))
    return _explain_short_line(phases[2], straight)


def _explain_short_line(phase: Phase, short: list[CartesianLine]) -> NoMotion:
    longest = max(short, key=lambda line: line.length_m)
    reason = "out_of_reach" if longest.blocked_by == "the arm's reach" else "blocked"
    return NoMotion(phase, reason, f"after {longest.length_m:.3f} m of a straight line: {longest.blocked_by}")


def rank_pairs(start: Configurations, goal: Configurations) -> list[tuple[int, int]]:
    """Rank pairs of rows of two sets of configurations, the nearest first."""
    distance = np.abs(start[:, None] - goal[None]).max(axis=2)
    order = np.argsort(distance, axis=None, kind="stable")
    return [(int(k) // len(goal), int(k) % len(goal)) for k in order]
