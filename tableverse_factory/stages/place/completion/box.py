"""Fit of a box that stands upright on the object's support."""

from dataclasses import dataclass

import manifold3d
import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize

from schemas.geometry import Frozen, Matrix3, Pose, TriangleMesh, Vector3
from tableverse_factory.geometry.math.planes import fit_min_rectangle
from tableverse_factory.geometry.math.transforms import quaternion_about_z
from tableverse_factory.geometry.mesh.voxel_solids import from_manifold
from tableverse_factory.geometry.registration.symmetry import rotation_about_axis
from tableverse_factory.stages.place.completion.ray_misfit import RaySample, compute_misfit, intersect_box
from tableverse_factory.stages.place.view.object_view import ObjectView

MIN_SIDE_M, MAX_SIDE_M = 0.003, 2.0
CARRY_WEIGHT = 0.02
EDGES_ON_LONGEST_SIDE = 20
PRIOR_M = 2e-4  # weight of the prior on unobserved sides: small against the evidence of a single pixel column [m]


@dataclass(frozen=True, slots=True, eq=False)
class SolidBox(Frozen):
    """A box: its frame at the centre, along its sides, in the table frame; half sizes and misfit to the picture [m]."""

    pose: Pose
    half_size: Vector3
    misfit: float


def fit_upright_box(view: ObjectView, rays: RaySample) -> SolidBox:
    """Fit the best box that stands flat on the object's support."""
    return min((_fit_upright(view, rays, yaw) for yaw in _propose_yaws(view)), key=lambda box: box.misfit)


def build_box_mesh(box: SolidBox) -> TriangleMesh:
    """Build the box in its own frame, its faces divided so that vertex colours can show the picture."""
    size = 2 * box.half_size
    solid = manifold3d.Manifold.cube(tuple(float(s) for s in size), True)
    return from_manifold(solid.refine_to_length(float(size.max()) / EDGES_ON_LONGEST_SIDE))


def _propose_yaws(view: ObjectView) -> list[float]:
    """Propose headings modulo a quarter turn: of the smallest rectangle, and of the upright faces' normals."""
    yaws = [fit_min_rectangle(view.points[:, :2]).yaw]
    sideways = np.abs(view.normals[:, 2]) < 0.4
    if sideways.sum() > 20:
        angle = np.arctan2(view.normals[sideways, 1], view.normals[sideways, 0])
        yaws.append(float(np.angle(np.exp(4j * angle).mean()) / 4))
    return yaws


def _fit_upright(view: ObjectView, rays: RaySample, yaw: float) -> SolidBox:
    axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    local = view.points[:, :2] @ axes.T
    low, high = np.quantile(local, 0.005, axis=0), np.quantile(local, 0.995, axis=0)
    top = max(float(np.quantile(view.points[:, 2], 0.98)), view.support_z + MIN_SIDE_M)
    middle = axes.T @ ((low + high) / 2)
    start = np.array([*middle, *np.log(np.maximum(high - low, MIN_SIDE_M)), np.log(top - view.support_z), yaw])

    def cost(x: Float64[np.ndarray, "6"]) -> float:
        position, rotation, half = _decode_box(x, view.support_z)
        prior = PRIOR_M * float(np.abs(np.log(half[:2] / np.sort(half)[1])).sum())
        misfit = compute_misfit(rays, intersect_box(rays, position, rotation, half))
        return misfit + prior + _penalize_uncarried(view, position, rotation, half)

    steps = np.diag([0.006, 0.006, 0.06, 0.06, 0.04, 0.06])
    simplex = np.vstack([start, start + steps])
    options = {"initial_simplex": simplex, "maxfev": 240, "xatol": 2e-4, "fatol": 1e-6}
    found = minimize(cost, start, method="Nelder-Mead", options=options)
    position, rotation, half = _decode_box(found.x, view.support_z)
    misfit = compute_misfit(rays, intersect_box(rays, position, rotation, half))
    return SolidBox(Pose(position, quaternion_about_z(float(found.x[5]))), half, misfit)


def _penalize_uncarried(view: ObjectView, position: Vector3, rotation: Matrix3, half: Vector3) -> float:
    """Compute the penalty for what stands on the object but not above the box, which hides the box's extent [m]."""
    carried = view.support.carried
    if len(carried) == 0:
        return 0.0
    local = (carried - position[:2]) @ rotation[:2, :2]
    return CARRY_WEIGHT * float(np.maximum(np.abs(local) - half[:2], 0.0).sum(axis=1).mean())


def _decode_box(x: Float64[np.ndarray, "6"], support_z: float) -> tuple[Vector3, Matrix3, Vector3]:
    """Decode centre x and y, logarithms of the sides and yaw to the centre, the axes as columns and half sizes."""
    half = np.minimum(np.maximum(np.exp(x[2:5]), MIN_SIDE_M), MAX_SIDE_M) / 2
    return np.array([x[0], x[1], support_z + half[2]]), rotation_about_axis(2, float(x[5])), half
