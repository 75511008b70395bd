"""Pick-and-place task: allowed contacts in each phase between a grasp and a release.

| phase | checked | may touch |
|---|---|---|
| pre-grasp | arm, open fingers | nothing, at the planning margin |
| grasp (approach) | arm, open fingers | nothing: fingers that touch the object before they close would push it |
| post-grasp (lift) | arm, holding fingers, the object | the object its initial contacts, no deeper |
| pre-place | the same | nothing, at the planning margin |
| place (lowering) | the same | the object its contacts at the release, at 0 mm |
| post-place | arm, open fingers; the object where it was released | nothing |

Contacts of the carried object with the holding fingers and hand are ignored; the hand is checked against the object in
the approach, at the same relative pose.
"""

from dataclasses import dataclass, replace

import numpy as np

from schemas.geometry import Frozen, Pose
from schemas.trajectories import JointVector
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose, translate_pose
from tableverse_factory.robotics.motion.dynamics import CarriedObject
from tableverse_factory.robotics.motion.world import CONTACT_TOLERANCE_M, CollisionSpace, CollisionWorld, Pair
from tableverse_factory.robotics.robots.gripper_clearance import compute_approach_openings

LINE_MARGIN_M = 0.0003  # clearance on straight lines near objects, for deviations of the blend and of the servos' steps
RESTING_GAP_M = 0.0006  # objects nearer than this to the carried object count as its contacts [m]


@dataclass(frozen=True, slots=True, eq=False)
class PickPlace(Frozen):
    """An object, two TCP poses in the table frame, and the collision spaces that follow from them.

    Attributes:
        width_m: Distance between the fingers that hold the object [m].
        taken: Pairs of the object that may touch in the lift, with their maximum depth [m].
        released: The same for the lowering.
    """

    world: CollisionWorld
    object_id: str
    tcp_grasp: Pose
    tcp_place: Pose
    width_m: float
    taken: tuple[tuple[Pair, float], ...] = ()
    released: tuple[tuple[Pair, float], ...] = ()

    @property
    def carried(self) -> CarriedObject:
        """The object as held in the gripper."""
        standing = self.world.object_pose(self.object_id)
        return CarriedObject(self.object_id, compose_poses(invert_pose(self.tcp_grasp), standing))

    def openings(self) -> tuple[float, ...]:
        """Return openings to try: just wider than the object, then the widest [m]."""
        widest = self.world.station.arm.max_opening_m
        usual = float(compute_approach_openings(np.array([self.width_m]), widest)[0])
        return (usual, widest) if usual < widest else (widest,)

    def reaching_space(self, opening_m: float, margin_m: float) -> CollisionSpace:
        """Return free space with open fingers and the scene as exported."""
        return self.world.space(opening_m, margin_m=margin_m)

    def lifting_space(self, margin_m: float) -> CollisionSpace:
        """Return free space with the object held, its initial contacts allowed."""
        return self._holding_space(margin_m, self.taken)

    def carrying_space(self, margin_m: float) -> CollisionSpace:
        """Return free space with the object held, no contact allowed."""
        return self._holding_space(margin_m, ())

    def lowering_space(self, margin_m: float) -> CollisionSpace:
        """Return free space with the object held, its contacts at the release allowed."""
        return self._holding_space(margin_m, self.released)

    def leaving_space(self, opening_m: float, margin_m: float) -> CollisionSpace:
        """Return free space with open fingers and the object where it was released."""
        placed = compose_poses(self.tcp_place, self.carried.object_to_tcp)
        return self.world.space(opening_m, margin_m=margin_m, standing={self.object_id: placed})

    def compute_depth_at(self, q: JointVector) -> float:
        """Compute the object's deepest penetration at a configuration, allowing none; at least 0 [m]."""
        return max(0.0, -min(self._find_contacts(q).values(), default=0.0))

    def raise_release(self, height_m: float) -> "PickPlace":
        """Return the task with a higher release."""
        return replace(self, tcp_place=translate_pose(self.tcp_place, np.array([0.0, 0.0, height_m])))

    def allow_grasp_contacts(self, q: JointVector) -> "PickPlace":
        """Allow, while lifting, the object's contacts at a grasp configuration, as deep as there."""
        pairs = {pair: min(depth, 0.0) for pair, depth in self._find_contacts(q).items()}
        return replace(self, taken=tuple(sorted(pairs.items())))

    def allow_release_contacts(self, q: JointVector) -> "PickPlace":
        """Allow, while lowering, the object's contacts at a release configuration, at 0 mm."""
        pairs = {pair: 0.0 for pair, depth in self._find_contacts(q).items() if depth >= -CONTACT_TOLERANCE_M}
        return replace(self, released=tuple(sorted(pairs.items())))

    def _holding_space(self, margin_m: float, resting: tuple[tuple[Pair, float], ...]) -> CollisionSpace:
        return self.world.space(self.width_m, margin_m=margin_m, carried=self.carried, resting=dict(resting))

    def _find_contacts(self, q: JointVector) -> dict[Pair, float]:
        space = self.carrying_space(RESTING_GAP_M)
        return self.world.select_object_pairs(self.object_id, self.world.find_contacts(space, q))
