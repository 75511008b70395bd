"""Objects as rigid parts for rectification: convex pieces, a box and a footprint seen from above."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypedDict

import numpy as np
from jaxtyping import Float64
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import ConvexPieces, Points, Pose, Quaternion, Vector3
from schemas.objects import PlacedObject
from tableverse_factory.geometry.collision.linear_sweep import MovingSolid
from tableverse_factory.geometry.collision.solids import Solids, concatenate_solids, place_pieces
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.transforms import (
    compose_poses,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_matrix,
    transform_points,
    translate_pose,
)
from tableverse_factory.geometry.mesh.mass_integrals import compute_volumes_and_centers
from tableverse_factory.geometry.mesh.meshes import place_mesh

Vector2 = Float64[np.ndarray, "2"]
Box2 = Float64[np.ndarray, "2 2"]  # lowest and highest corner, seen from above [m]

FOOTPRINT_STEP_M2 = 1e-10
LEAST_VOLUME_M3 = 1e-18  # of a piece, so that no part weighs nothing


class _Measures(TypedDict):
    box: Box2
    lowest_m: float


@dataclass(frozen=True, slots=True, eq=False)
class RigidPart:
    """One object: where it was placed, turned by `turned_by` since, and moved by `body.offset`, which only `_now` adds.

    Attributes:
        object_id: Decides ties, so that the order of a file does not matter.
        box: Top-view box of the mesh [m].
        lowest_m: Height of the lowest vertex of mesh and pieces [m].
        footprint_m2: Area of the convex hull of its pieces seen from above, where it was placed [m²].
        heading: Its own x axis seen from above (y where x is upright), unit length.
        mass_center: Centre of mass of its pieces [m].
        volume_m3: Of its pieces, overlaps counted twice [m³].
        vertices: Of its mesh. Shape (n, 3) [m].
        turned_by: Rotation about its centre of mass.
    """

    object_id: str
    container_id: str | None
    body: MovingSolid
    box: Box2
    lowest_m: float
    footprint_m2: float
    heading: Vector2
    mass_center: Vector3
    volume_m3: float
    vertices: Points
    turned_by: Quaternion

    def moved(self, by: Vector3) -> "RigidPart":
        """Translate by another `by` [m]."""
        return replace(self, body=self.body.moved(by))

    def turned(self, rotation_vector: Vector3) -> "RigidPart":
        """Rotate about the centre of mass by a rotation vector [rad]."""
        return self.turned_by_quaternion(quaternion_from_rotation_vector(rotation_vector))

    def turned_by_quaternion(self, turn: Quaternion) -> "RigidPart":
        """Rotate about the centre of mass."""
        if turn[0] == 1.0:
            return self
        rotation = rotation_matrix(turn)
        solids = self.body.solids.turned(rotation, self.mass_center)
        vertices = (self.vertices - self.mass_center) @ rotation.T + self.mass_center
        return replace(
            self,
            body=replace(self.body, solids=solids),
            heading=_normalize(rotation[:2, :2] @ self.heading),
            vertices=vertices,
            turned_by=multiply_quaternions(turn, self.turned_by),
            **_measure_extent(vertices, solids),
        )

    def rounded(self, decimals: int) -> "RigidPart":
        """Round coordinates at the current position, to remove rounding errors."""
        solids = concatenate_solids([self.body.solids], [self.body.offset]).rounded(decimals)
        vertices = np.round(self.vertices + self.body.offset, decimals)
        return replace(
            self,
            body=replace(self.body, solids=solids, offset=np.zeros(3)),
            vertices=vertices,
            heading=np.round(self.heading, decimals),
            mass_center=np.round(self.mass_center_now, decimals),
            **_measure_extent(vertices, solids),
        )

    def pose_now(self, pose: Pose) -> Pose:
        """Current pose of the object that was placed at this pose."""
        if self.turned_by[0] == 1.0:
            return translate_pose(pose, self.body.offset)
        turn = Pose(np.zeros(3), self.turned_by)
        about = compose_poses(turn, Pose(pose.position - self.mass_center, pose.quaternion_wxyz))
        return translate_pose(about, self.mass_center + self.body.offset)

    @property
    def lowest_now_m(self) -> float:
        """Current height of the lowest vertex [m]."""
        return self.lowest_m + float(self.body.offset[2])

    @property
    def mass_center_now(self) -> Vector3:
        """Current centre of mass [m]."""
        return self.mass_center + self.body.offset


def make_rigid_part(item: PlacedObject, pieces: ConvexPieces) -> RigidPart:
    """Make the part of a placed object."""
    solids = place_pieces(pieces, item.pose, item.scale)
    vertices = place_mesh(item.mesh, item.pose, item.scale).vertices
    volumes, centers = compute_volumes_and_centers(pieces.hulls, LEAST_VOLUME_M3)
    axes = rotation_matrix(item.pose.quaternion_wxyz)[:2, :2].T
    center = np.average(centers, axis=0, weights=volumes)  # in the mesh's own frame
    return RigidPart(
        object_id=item.object_id,
        container_id=item.contained_in,
        body=MovingSolid(solids, np.zeros(3), item.scale * pieces.uncovered_m),
        heading=_normalize(axes[0] if np.linalg.norm(axes[0]) > 0.5 else axes[1]),
        mass_center=transform_points(item.pose, center[None], item.scale)[0],
        volume_m3=float(volumes.sum()) * item.scale**3,
        footprint_m2=_compute_hull_area(solids.points[:, :2]),
        vertices=vertices,
        turned_by=np.array([1.0, 0.0, 0.0, 0.0]),
        **_measure_extent(vertices, solids),
    )


def merge_rigid_parts(parts: Sequence[RigidPart]) -> RigidPart:
    """Merge parts into one rigid body, under the smallest of their ids."""
    if len(parts) == 1:
        return parts[0]
    solids = concatenate_solids([part.body.solids for part in parts], [part.body.offset for part in parts])
    vertices = np.concatenate([part.vertices + part.body.offset for part in parts])
    volumes = np.array([part.volume_m3 for part in parts])
    return replace(
        parts[0],
        object_id=min(part.object_id for part in parts),
        container_id=None,
        body=MovingSolid(solids, np.zeros(3), max(part.body.uncovered_m for part in parts)),
        mass_center=np.average([part.mass_center_now for part in parts], axis=0, weights=volumes),
        volume_m3=float(volumes.sum()),
        footprint_m2=_compute_hull_area(solids.points[:, :2]),
        vertices=vertices,
        turned_by=np.array([1.0, 0.0, 0.0, 0.0]),
        **_measure_extent(vertices, solids),
    )


def follow_body(part: RigidPart, before: RigidPart, after: RigidPart) -> RigidPart:
    """Move a part along with the merged body that moved from `before` to `after`."""
    rotation = rotation_matrix(after.turned_by)
    center = part.mass_center_now
    moved = rotation @ (center - before.mass_center_now) + after.mass_center_now
    return part.turned_by_quaternion(after.turned_by).moved(moved - center)


def compute_box(parts: Sequence[RigidPart]) -> Box2:
    """Compute the top-view box around parts [m]."""
    boxes = np.array([part.box + part.body.offset[:2] for part in parts])
    return np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


def compute_center(parts: Sequence[RigidPart]) -> Vector2:
    """Compute the centre of the top-view box around parts [m]."""
    return compute_box(parts).mean(axis=0)


def compute_overlap_ratio(a: Box2, b: Box2) -> float:
    """Compute the area shared by two boxes over that of the smaller one; 0 where that one has no area."""
    sides = np.minimum(a[1], b[1]) - np.maximum(a[0], b[0])
    smaller = min(float(np.prod(a[1] - a[0])), float(np.prod(b[1] - b[0])))
    return float(np.prod(sides)) / smaller if (sides > 0.0).all() and smaller > 0.0 else 0.0


def compute_breadth(parts: Sequence[RigidPart]) -> int:
    """Compute the largest footprint of parts, rounded so that only rounding errors become ties."""
    return round(max(part.footprint_m2 for part in parts) / FOOTPRINT_STEP_M2)


def _measure_extent(vertices: Points, solids: Solids) -> _Measures:
    low, high = aabb(vertices)
    return {"box": np.array([low[:2], high[:2]]), "lowest_m": float(min(low[2], solids.low[:, 2].min()))}


def _compute_hull_area(points: Points) -> float:
    try:
        return float(ConvexHull(points).volume)  # of a plane hull, this is the area
    except QhullError:  # seen edge-on
        return 0.0


def _normalize(axis: Vector2) -> Vector2:
    return axis / np.linalg.norm(axis)
