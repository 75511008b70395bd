"""One object taken at one pose of the TCP and let go at another: what may touch what in each phase.

| phase | looked at | may touch |
|---|---|---|
| pre-grasp | arm, open fingers | nothing, at the planning margin |
| grasp (approach) | arm, open fingers | nothing: fingers that touch the object before they close would push it |
| post-grasp (lift) | arm, holding fingers, the object | the object what it touches where it stands, no deeper |
| pre-place | the same | nothing, at the planning margin |
| place (lowering) | the same | the object what it touches where it is let go, at 0 mm |
| post-place | arm, open fingers; the object stands where it was let go | nothing |

The fingers and the hand that hold it are not looked at against the carried object; the hand is against the same
object in the approach, at the same relative pose.
"""

from dataclasses import dataclass, replace

import numpy as np

from schemas.geometry import Frozen, Pose
from schemas.trajectories import JointVector
from tableverse_factory.geometry.transforms import compose, inverse, translated
from tableverse_factory.motion.carried import Carried
from tableverse_factory.motion.world import EXACT_M, Pair, Space, World

LINE_MARGIN_M = 0.0003
"""On straight lines near things: what the blend and the servos' steps may stray without touching."""
RESTING_GAP_M = 0.0006
"""What is nearer than this to the carried object where it stands is touched by it [m]."""
FINGER_ROOM_M = 0.02
"""Narrow opening: the object's width and this much [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Handling(Frozen):
    """An object, the two poses of the TCP, and the collision spaces that follow from them.

    Attributes:
        world: Robot and scene.
        object_id: What is taken.
        tcp_grasp: Where, in the table frame.
        tcp_place: Where it is let go, in the table frame.
        width_m: Distance between the fingers that hold it [m].
        resting: Pairs of the object that may touch on the lines, and how deep at most [m].
    """

    world: World
    object_id: str
    tcp_grasp: Pose
    tcp_place: Pose
    width_m: float
    resting: tuple[tuple[Pair, float], ...] = ()

    @property
    def carried(self) -> Carried:
        """The object as it hangs in the gripper."""
        standing = self.world.object_pose(self.object_id)
        return Carried(self.object_id, compose(inverse(self.tcp_grasp), standing))

    def openings(self) -> tuple[float, ...]:
        """Distances between open fingers that are tried: just wider than the object, then as wide as can be [m]."""
        widest = self.world.station.arm.max_opening_m
        narrow = self.width_m + FINGER_ROOM_M
        return (narrow, widest) if narrow < 0.95 * widest else (widest,)

    def reaching(self, opening_m: float, margin_m: float) -> Space:
        """With open fingers, the scene as exported."""
        return self.world.space(opening_m, margin_m=margin_m)

    def carrying(self, margin_m: float, *, resting: bool) -> Space:
        """With the object in the gripper; `resting` where it may touch what it stands on."""
        allowed = dict(self.resting) if resting else {}
        return self.world.space(self.width_m, margin_m=margin_m, carried=self.carried, resting=allowed)

    def leaving(self, opening_m: float, margin_m: float) -> Space:
        """With open fingers, the object where it was let go."""
        placed = compose(self.tcp_place, self.carried.object_to_tcp)
        return self.world.space(opening_m, margin_m=margin_m, standing={self.object_id: placed})

    def depth_at(self, q: JointVector) -> float:
        """How deep the object is in something at a configuration, nothing being forgiven; at least 0 [m]."""
        return max(0.0, -min(self._touched(q).values(), default=0.0))

    def raised(self, height_m: float) -> "Handling":
        """Let go this much higher."""
        return replace(self, tcp_place=translated(self.tcp_place, np.array([0.0, 0.0, height_m])))

    def taken_at(self, q: JointVector) -> "Handling":
        """With leave to touch, while lifted, whatever it touches at a configuration of the grasp, as deep as there."""
        return self._allowing({pair: min(depth, 0.0) for pair, depth in self._touched(q).items()})

    def released_at(self, q: JointVector) -> "Handling":
        """With leave to touch, while lowered, whatever it touches at a configuration of the release, at 0 mm."""
        return self._allowing({pair: 0.0 for pair, depth in self._touched(q).items() if depth >= -EXACT_M})

    def _allowing(self, more: dict[Pair, float]) -> "Handling":
        merged = dict(self.resting)
        for pair, depth in more.items():
            merged[pair] = min(depth, merged.get(pair, np.inf))
        return replace(self, resting=tuple(sorted(merged.items())))

    def _touched(self, q: JointVector) -> dict[Pair, float]:
        space = self.carrying(RESTING_GAP_M, resting=False)
        return self.world.pairs_of(self.object_id, self.world.touching(space, q))
