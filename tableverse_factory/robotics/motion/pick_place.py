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
from tableverse_factory.geometry.math.transforms import compose, inverse, translated
from tableverse_factory.robotics.motion.carried_object import Carried
from tableverse_factory.robotics.motion.world import EXACT_M, Pair, Space, World
from tableverse_factory.robotics.robots.gripper_clearance import openings

LINE_MARGIN_M = 0.0003
"""On straight lines near things: what the blend and the servos' steps may stray without touching."""
RESTING_GAP_M = 0.0006
"""What is nearer than this to the carried object where it stands is touched by it [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Handling(Frozen):
    """An object, the two poses of the TCP, and the collision spaces that follow from them.

    Attributes:
        world: Robot and scene.
        object_id: What is taken.
        tcp_grasp: Where, in the table frame.
        tcp_place: Where it is let go, in the table frame.
        width_m: Distance between the fingers that hold it [m].
        taken: Pairs of the object that may touch in the lift, and how deep at most [m].
        released: The same in the lowering.
    """

    world: World
    object_id: str
    tcp_grasp: Pose
    tcp_place: Pose
    width_m: float
    taken: tuple[tuple[Pair, float], ...] = ()
    released: tuple[tuple[Pair, float], ...] = ()

    @property
    def carried(self) -> Carried:
        """The object as it hangs in the gripper."""
        standing = self.world.object_pose(self.object_id)
        return Carried(self.object_id, compose(inverse(self.tcp_grasp), standing))

    def openings(self) -> tuple[float, ...]:
        """Distances between open fingers that are tried: just wider than the object, then as wide as can be [m]."""
        widest = self.world.station.arm.max_opening_m
        usual = float(openings(np.array([self.width_m]), widest)[0])
        return (usual, widest) if usual < widest else (widest,)

    def reaching(self, opening_m: float, margin_m: float) -> Space:
        """With open fingers, the scene as exported."""
        return self.world.space(opening_m, margin_m=margin_m)

    def lifting(self, margin_m: float) -> Space:
        """With the object in the gripper, which may touch what it touches where it stands."""
        return self._holding(margin_m, self.taken)

    def carrying(self, margin_m: float) -> Space:
        """With the object in the gripper, which touches nothing."""
        return self._holding(margin_m, ())

    def lowering(self, margin_m: float) -> Space:
        """With the object in the gripper, which may touch what it touches where it is let go."""
        return self._holding(margin_m, self.released)

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
        pairs = {pair: min(depth, 0.0) for pair, depth in self._touched(q).items()}
        return replace(self, taken=tuple(sorted(pairs.items())))

    def released_at(self, q: JointVector) -> "Handling":
        """With leave to touch, while lowered, whatever it touches at a configuration of the release, at 0 mm."""
        pairs = {pair: 0.0 for pair, depth in self._touched(q).items() if depth >= -EXACT_M}
        return replace(self, released=tuple(sorted(pairs.items())))

    def _holding(self, margin_m: float, resting: tuple[tuple[Pair, float], ...]) -> Space:
        return self.world.space(self.width_m, margin_m=margin_m, carried=self.carried, resting=dict(resting))

    def _touched(self, q: JointVector) -> dict[Pair, float]:
        space = self.carrying(RESTING_GAP_M)
        return self.world.pairs_of(self.object_id, self.world.touching(space, q))
