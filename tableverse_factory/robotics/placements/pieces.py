"""Where convex pieces are free: height maps see meshes, but what planners and simulators collide with are pieces."""

from collections.abc import Sequence

import numpy as np

from schemas.geometry import Vector3
from tableverse_factory.geometry.collision.ray_clearance import MovingSolid, Ray
from tableverse_factory.geometry.collision.solids import Solids
from tableverse_factory.geometry.math.transforms import rotation_matrix, transform_points
from tableverse_factory.physics.mjcf.scene_objects import SceneObject
from tableverse_factory.robotics.placements.orientations import Turn


class Pieces:
    """The pieces of an object, and of the things near the place where it is to be let go."""

    def __init__(self, x: SceneObject, near: Sequence[SceneObject]) -> None:
        self._standing = _solids(x)
        self._near = [MovingSolid(_solids(thing), np.zeros(3)) for thing in near]
        self._turned: dict[bytes, Solids] = {}
        self._up = Ray(np.array([0.0, 0.0, 1.0]))

    def rise(self, turn: Turn, offset: Vector3, clearance_m: float) -> float:
        """How far above its place the object is first `clearance_m` from all things [m], exactly.

        Args:
            turn: How it is held.
            offset: From the turned object to its place [m].
            clearance_m: What is kept [m].
        """
        key = turn.quaternion_wxyz.tobytes()
        if key not in self._turned:
            self._turned[key] = self._standing.turned(rotation_matrix(turn.quaternion_wxyz), np.zeros(3))
        return self._up.first_clear([MovingSolid(self._turned[key], offset)], self._near, clearance_m)


def _solids(thing: SceneObject) -> Solids:
    return Solids([transform_points(thing.pose, hull.vertices) for hull in thing.hulls], [h.faces for h in thing.hulls])
