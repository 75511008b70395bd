"""Where the arm takes or lets go of something: configurations there, with the two straight lines that lead away.

Taking and letting go are mirror images: one line with empty open fingers, back along the approach, and one with the
object, straight up.
"""

from dataclasses import dataclass

import numpy as np

from schemas.geometry import Frozen, Pose
from schemas.trajectories import JointVector, NoMotion, Phase
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.robotics.motion.kinematics import Configurations, solutions
from tableverse_factory.robotics.motion.lines import Line, lines
from tableverse_factory.robotics.motion.world import Space, World
from tableverse_factory.robotics.robots.gripper_clearance import RISE_M, STANDOFF_M

BRANCHES = 6
"""Configurations that are tried for one pose of the TCP."""
LEAST_SHARE = 0.4
"""A line that something ends early will do if at least this share of it is left; that is recorded."""
SLANT_RAD = 0.26
"""Where something hangs over the way up, lines that lean this much to one side are tried."""
_SIDES = np.arange(6) * np.pi / 3
_UP = np.array([0.0, 0.0, 1.0])
_SLANTED = [
    np.array([np.sin(SLANT_RAD) * np.cos(side), np.sin(SLANT_RAD) * np.sin(side), np.cos(SLANT_RAD)]) for side in _SIDES
]


@dataclass(frozen=True, slots=True, eq=False)
class ApproachConfig(Frozen):
    """One way to stand at the grasp or at the release.

    Attributes:
        opening_m: Distance between the open fingers [m].
        hand: With empty fingers, from here back along the approach.
        load: With the object, from here upwards.
        slanted: Whether that line leans to one side.
    """

    opening_m: float
    hand: Line
    load: Line
    slanted: bool

    @property
    def q(self) -> JointVector:
        """The configuration itself."""
        first: JointVector = self.hand.path[0]
        return first

    def fallbacks(self, hand: Phase, load: Phase) -> tuple[str, ...]:
        """Which of its lines are shorter than usual, in words."""
        found = ((hand, self.hand, STANDOFF_M), (load, self.load, RISE_M))
        short = tuple(
            f"{phase}: {line.length_m:.3f} m" for phase, line, usual in found if line.length_m < 0.999 * usual
        )
        return (*short, f"{load}: slanted") if self.slanted else short


def touches(
    world: World, tcp: Pose, near: JointVector, hand: Space, load: Space, phases: tuple[Phase, Phase, Phase]
) -> tuple[ApproachConfig, ...] | NoMotion:
    """All ways to stand at a pose with both lines free, nearest to `near` first; or why there is none.

    Args:
        world: Robot and scene.
        tcp: In the table frame.
        near: Preferred configuration. Shape (j,) [rad].
        hand: What is free with empty fingers.
        load: What is free with the object.
        phases: To blame for the pose itself, for the line of the hand and for that of the load.
    """
    found = solutions(world.chain, world.in_base(tcp), near, BRANCHES)
    if not len(found):
        x, y, z = tcp.position
        return NoMotion(phases[0], "out_of_reach", f"no configuration has the gripper at ({x:.3f}, {y:.3f}, {z:.3f}) m")
    clear = np.array([hand.free(q) and load.free(q) for q in found])
    if not clear.any():
        nearest = min(found, key=lambda q: max(world.depth(hand, q), world.depth(load, q)))
        why = world.blocked_by(hand, nearest) or world.blocked_by(load, nearest)
        return NoMotion(phases[0], "blocked", why)
    back = -rotation_matrix(tcp.quaternion_wxyz)[:, 2]
    hands = lines(world, hand, found[clear], tcp, back, STANDOFF_M)
    chosen = [k for k, line in enumerate(hands) if line.length_m >= LEAST_SHARE * STANDOFF_M]
    if not chosen:
        return _ended(phases[1], hands)
    straight: list[Line] = []
    for direction in (_UP, *_SLANTED):
        loads = lines(world, load, found[clear][chosen], tcp, direction, RISE_M)
        straight = straight or loads
        ways = [
            ApproachConfig(hand.opening_m, hands[k], line, direction is not _UP)
            for k, line in zip(chosen, loads, strict=True)
            if line.length_m >= LEAST_SHARE * RISE_M
        ]
        if ways:
            return tuple(sorted(ways, key=_shortfall))
    return _ended(phases[2], straight)


def _shortfall(way: ApproachConfig) -> bool:
    """Full lines before short ones; within each, the order stays."""
    return bool(way.fallbacks(Phase.GRASP, Phase.GRASP))


def _ended(phase: Phase, short: list[Line]) -> NoMotion:
    longest = max(short, key=lambda line: line.length_m)
    reason = "out_of_reach" if longest.blocked_by == "the arm's reach" else "blocked"
    return NoMotion(phase, reason, f"after {longest.length_m:.3f} m of a straight line: {longest.blocked_by}")


def spread(start: Configurations, goal: Configurations) -> list[tuple[int, int]]:
    """Pairs of rows, the nearest first. Shapes (n, j) and (m, j)."""
    distance = np.abs(start[:, None] - goal[None]).max(axis=2)
    order = np.argsort(distance, axis=None, kind="stable")
    return [(int(k) // len(goal), int(k) % len(goal)) for k in order]
