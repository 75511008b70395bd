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
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose
from tableverse_factory.robotics.motion.dynamics import CarriedObject
from tableverse_factory.robotics.motion.world import CONTACT_TOLERANCE_M, CollisionSpace, CollisionWorld, Pair
from tableverse_factory.robotics.robots.gripper_clearance import compute_approach_openings

LINE_MARGIN_M = 0.0003  # clearance on straight lines near objects, for deviations of the blend and of the servos' steps
RESTING_GAP_M = 0.0006  # objects nearer than this to the carried object count as its contacts [m]


@dataclass(frozen=True, slots=True, eq=False)
class PickPlace(Frozen):
    """An object, two TCP poses in the table frame, and the collision spaces that follow from them.

    `taken` and `released` are pairs of the object that may touch in the lift and in the lowering, with their depth [m].
    """

    world: CollisionWorld
    object_id: str
    tcp_grasp: Pose
    tcp_place: Pose
    width_m: float  # distance between the fingers that hold the object
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
        return CollisionSpace(self.world, opening_m, margin_m)

    def holding_space(self, margin_m: float, resting: tuple[tuple[Pair, float], ...] = ()) -> CollisionSpace:
        """Return free space with the object held, and contacts allowed: none, those of the grasp or of the release."""
        return CollisionSpace(self.world, self.width_m, margin_m, self.carried, resting=dict(resting))

    def leaving_space(self, opening_m: float, margin_m: float) -> CollisionSpace:
        """Return free space with open fingers and the object where it was released."""
        placed = compose_poses(self.tcp_place, self.carried.object_to_tcp)
        return CollisionSpace(self.world, opening_m, margin_m, standing={self.object_id: placed})

    def compute_depth_at(self, q: JointVector) -> float:
        """Compute the object's deepest penetration at a configuration, allowing none; at least 0 [m]."""
        return max(0.0, -min(self._find_contacts(q).values(), default=0.0))

    def allow_grasp_contacts(self, q: JointVector) -> "PickPlace":
        """Allow, while lifting, the object's contacts at a grasp configuration, as deep as there."""
        pairs = {pair: min(depth, 0.0) for pair, depth in self._find_contacts(q).items()}
        return replace(self, taken=tuple(sorted(pairs.items())))

    def allow_release_contacts(self, q: JointVector) -> "PickPlace":
        """Allow, while lowering, the object's contacts at a release configuration, at 0 mm."""
        pairs = {pair: 0.0 for pair, depth in self._find_contacts(q).items() if depth >= -CONTACT_TOLERANCE_M}
        return replace(self, released=tuple(sorted(pairs.items())))

    def _find_contacts(self, q: JointVector) -> dict[Pair, float]:
        pairs = self.world.find_contacts(self.holding_space(RESTING_GAP_M), q)
        return self.world.select_object_pairs(self.object_id, pairs)
