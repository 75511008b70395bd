"""Whether a parallel gripper can take hold of a body: antipodal pairs of surface points, and room for the fingers.

A quick test, not a grasp planner: it decides which objects tasks may ask for.
"""

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from jaxtyping import Float64

from schemas.geometry import Frozen, Points, TriangleMesh
from tableverse_factory.geometry.mesh.height_maps import Caster
from tableverse_factory.geometry.mesh.mass_integrals import signed_volume
from tableverse_factory.geometry.mesh.surface_samples import surface_samples

FRICTION = 0.5
"""Coulomb coefficient of pad on object; the contact normals lie within its cone about the closing axis."""

MIN_WIDTH_M = 0.001
FINGER_M = 0.012
"""Thickness of a finger beyond the contact."""

MAX_AXIS_SLOPE = 0.6
"""Largest vertical part of the closing axis: fingers come from above or from the side, never from below."""

MIN_HEIGHT_M = 0.004
"""Contacts nearer to what the body stands on are out of the fingertips' reach."""

_SAMPLES = 512
_OFF_M = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Grips(Frozen):
    """Antipodal pairs of contacts.

    Attributes:
        first: Contact of one finger. Shape (n, 3) [m].
        second: Contact of the other. Shape (n, 3) [m].
        share: Pairs found over surface points tried.
    """

    first: Points
    second: Points
    share: float

    def fingers(self) -> Float64[np.ndarray, "n 2 3"]:
        """Middle of each finger just outside its contact [m]."""
        axis = self.second - self.first
        axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
        return np.stack([self.first - FINGER_M * axis, self.second + FINGER_M * axis], axis=1)


def antipodal_grips(mesh: TriangleMesh, caster: Caster, max_width: float) -> Grips:
    """Pairs between which a gripper of this opening [m] can close on a mesh that stands in the table frame.

    Args:
        mesh: As it stands [m].
        caster: Holds the same mesh.
        max_width: Opening of the gripper [m].
    """
    points, inward = surface_points(mesh, _SAMPLES)
    sign = outward_sign(mesh)
    inward = sign * inward
    width, normals = first_hits(caster, points, inward, sign)
    cone = 1.0 / np.sqrt(1.0 + FRICTION**2)
    ends = points + np.where(np.isfinite(width), width, 0.0)[:, None] * inward
    height = np.minimum(points[:, 2], ends[:, 2]) - mesh.vertices[:, 2].min()
    good = (width >= MIN_WIDTH_M) & (width <= max_width) & (height >= MIN_HEIGHT_M)
    good &= (np.einsum("ij,ij->i", normals, inward) >= cone) & (np.abs(inward[:, 2]) <= MAX_AXIS_SLOPE)
    return Grips(points[good], ends[good], float(good.mean()))


def gripped_on(grips: Grips, felt: Caster, max_width: float) -> Grips:
    """Those of the pairs that hold as well on what a simulation feels of a body: its convex pieces.

    Pieces round off what is small, and where a neck becomes a cone, pads that close on it slide off.

    Args:
        grips: Of the mesh.
        felt: Holds the pieces of the same body where it stands, their normals outwards.
        max_width: Opening of the gripper [m].
    """
    if not len(grips.first):
        return grips
    axis = grips.second - grips.first
    width = np.linalg.norm(axis, axis=1)
    axis = axis / width[:, None]
    gap_first, normal_first = first_hits(felt, grips.first - FINGER_M * axis, axis, 1.0)
    gap_second, normal_second = first_hits(felt, grips.second + FINGER_M * axis, -axis, 1.0)
    width = width + 2 * FINGER_M - gap_first - gap_second
    cone = 1.0 / np.sqrt(1.0 + FRICTION**2)
    good = (width >= MIN_WIDTH_M) & (width <= max_width)
    good &= (np.einsum("ij,ij->i", normal_first, -axis) >= cone) & (np.einsum("ij,ij->i", normal_second, axis) >= cone)
    return Grips(grips.first[good], grips.second[good], grips.share * float(good.mean()))


def first_hits(caster: Caster, points: Points, ways: Points, sign: float) -> tuple[Float64[np.ndarray, " n"], Points]:
    """How far each ray goes from just behind its start until it hits [m], inf where it does not; the normals there.

    Args:
        caster: Holds the mesh.
        points: Starts; a surface that one lies on is not hit. Shape (n, 3) [m].
        ways: Unit directions. Shape (n, 3).
        sign: Of `outward_sign`; the normals then point out of the body. Shape (n, 3).
    """
    rays = np.concatenate([points + _OFF_M * ways, ways], axis=1).astype(np.float32)
    hits = caster.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=1)
    distance = hits["t_hit"].numpy().astype(np.float64) + _OFF_M
    return distance, sign * hits["primitive_normals"].numpy().astype(np.float64)


def outward_sign(mesh: TriangleMesh) -> float:
    """1 where the faces' normals point outwards, -1 where the mesh is inside out."""
    return 1.0 if signed_volume(mesh) >= 0.0 else -1.0


def surface_points(mesh: TriangleMesh, count: int) -> tuple[Points, Points]:
    """Points spread evenly over the surface, the same for the same mesh, and the inward unit normals there."""
    points, triangle = surface_samples(mesh, count)
    a, b, c = (mesh.vertices[mesh.faces[triangle, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    return points, -normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)
