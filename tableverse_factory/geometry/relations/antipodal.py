"""Antipodal pairs of surface points, at which a parallel gripper can hold a body, with room for its fingers.

A quick test, not a grasp planner: it decides which objects tasks may ask for.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Points, TriangleMesh
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume
from tableverse_factory.geometry.mesh.raycasting import RaycastingScene, pack_rays
from tableverse_factory.geometry.mesh.surface_samples import sample_surface

FRICTION = 0.5  # coulomb coefficient of pad on object; the contact normals lie within its cone about the closing axis
MIN_WIDTH_M = 0.001
FINGER_M = 0.012  # thickness of a finger beyond the contact
MAX_AXIS_SLOPE = 0.6  # largest vertical part of the closing axis: fingers come from above or beside, never from below
MIN_HEIGHT_M = 0.004  # contacts nearer to what the body stands on are out of the fingertips' reach
_SAMPLES = 512
_OFF_M = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Grips(Frozen):
    """Antipodal pairs of contacts, each (n, 3) [m], and their number over that of the surface points tried."""

    first: Points
    second: Points
    share: float

    def fingers(self) -> Float64[np.ndarray, "n 2 3"]:
        """Middle of each finger just outside its contact [m]."""
        axis = self.second - self.first
        axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
        return np.stack([self.first - FINGER_M * axis, self.second + FINGER_M * axis], axis=1)


def find_antipodal_grips(mesh: TriangleMesh, caster: RaycastingScene, max_width: float) -> Grips:
    """Find pairs between which a gripper that opens to `max_width` [m] can close on a mesh, which the caster holds."""
    points, inward = sample_inward_normals(mesh, _SAMPLES)
    sign = compute_outward_sign(mesh)
    inward = sign * inward
    width, normals = cast_surface_rays(caster, points, inward, sign)
    cone = 1.0 / np.sqrt(1.0 + FRICTION**2)
    ends = points + np.where(np.isfinite(width), width, 0.0)[:, None] * inward
    height = np.minimum(points[:, 2], ends[:, 2]) - mesh.vertices[:, 2].min()
    good = (width >= MIN_WIDTH_M) & (width <= max_width) & (height >= MIN_HEIGHT_M)
    good &= (np.einsum("ij,ij->i", normals, inward) >= cone) & (np.abs(inward[:, 2]) <= MAX_AXIS_SLOPE)
    return Grips(points[good], ends[good], float(good.mean()))


def filter_grips(grips: Grips, felt: RaycastingScene, max_width: float) -> Grips:
    """Select the pairs that also hold on a body's convex pieces, which is what a simulation feels.

    Pieces round off small features, and where a neck becomes a cone, pads that close on it slide off. `felt` holds the
    pieces of the same body where it stands, their normals outwards.
    """
    if not len(grips.first):
        return grips
    axis = grips.second - grips.first
    width = np.linalg.norm(axis, axis=1)
    axis = axis / width[:, None]
    gap_first, normal_first = cast_surface_rays(felt, grips.first - FINGER_M * axis, axis, 1.0)
    gap_second, normal_second = cast_surface_rays(felt, grips.second + FINGER_M * axis, -axis, 1.0)
    width = width + 2 * FINGER_M - gap_first - gap_second
    cone = 1.0 / np.sqrt(1.0 + FRICTION**2)
    good = (width >= MIN_WIDTH_M) & (width <= max_width)
    good &= (np.einsum("ij,ij->i", normal_first, -axis) >= cone) & (np.einsum("ij,ij->i", normal_second, axis) >= cone)
    return Grips(grips.first[good], grips.second[good], grips.share * float(good.mean()))


def cast_surface_rays(
    caster: RaycastingScene, points: Points, ways: Points, sign: float
) -> tuple[Float64[np.ndarray, " n"], Points]:
    """Cast rays from just behind their starts: the distance until each hits [m], else inf, and the normals there.

    The surface on which a start lies is not hit. With `compute_outward_sign` the normals point out of the body.
    """
    hits = caster.cast_rays(pack_rays(points + _OFF_M * ways, ways), nthreads=1)
    distance = hits["t_hit"].numpy().astype(np.float64) + _OFF_M
    return distance, sign * hits["primitive_normals"].numpy().astype(np.float64)


def compute_outward_sign(mesh: TriangleMesh) -> float:
    """1 where the faces' normals point outwards, -1 where the mesh is inside out."""
    return 1.0 if compute_signed_volume(mesh) >= 0.0 else -1.0


def sample_inward_normals(mesh: TriangleMesh, count: int) -> tuple[Points, Points]:
    """Sample points evenly over the surface, the same for the same mesh, with the inward unit normals there."""
    points, triangle = sample_surface(mesh, count)
    a, b, c = (mesh.vertices[mesh.faces[triangle, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    return points, -normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)
