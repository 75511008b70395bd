"""Clearance of convex pieces, which planners and simulators collide, beyond that of meshes seen by height maps."""

from collections.abc import Sequence

import numpy as np

from schemas.geometry import Vector3
from tableverse_factory.geometry.collision.linear_sweep import LinearSweep, MovingSolid
from tableverse_factory.geometry.collision.solids import Solids
from tableverse_factory.geometry.math.transforms import rotation_matrix, transform_points
from tableverse_factory.physics.mjcf.scene_objects import SceneObject
from tableverse_factory.robotics.placements.orientations import Orientation


class ConvexPieces:
    """Pieces of an object and of the objects near its placement."""

    def __init__(self, x: SceneObject, near: Sequence[SceneObject]) -> None:
        self._standing = _build_solids(x)
        self._near = [MovingSolid(_build_solids(scene_object), np.zeros(3)) for scene_object in near]
        self._rotated: dict[bytes, Solids] = {}
        self._up = LinearSweep(np.array([0.0, 0.0, 1.0]))

    def find_clear_height(self, turn: Orientation, offset: Vector3, clearance_m: float) -> float:
        """Find exactly how far above `offset` the rotated object first has `clearance_m` to all others [m]."""
        key = turn.quaternion_wxyz.tobytes()
        if key not in self._rotated:
            self._rotated[key] = self._standing.turned(rotation_matrix(turn.quaternion_wxyz), np.zeros(3))
        return self._up.first_clear([MovingSolid(self._rotated[key], offset)], self._near, clearance_m)


def _build_solids(scene_object: SceneObject) -> Solids:
    return Solids(
        [transform_points(scene_object.pose, hull.vertices) for hull in scene_object.hulls],
        [h.faces for h in scene_object.hulls],
    )
