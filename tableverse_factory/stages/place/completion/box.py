"""Fit of a box that stands upright on the object's support, and of the rounding of its upright edges."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from manifold3d import CrossSection, JoinType, Manifold

from schemas.geometry import Frozen, Matrix3, Pose, TriangleMesh, Vector3
from tableverse_factory.geometry.math.planes import fit_min_rectangle
from tableverse_factory.geometry.math.transforms import quaternion_about_z
from tableverse_factory.geometry.mesh.voxel_solids import from_manifold
from tableverse_factory.geometry.registration.symmetry import rotation_about_axis
from tableverse_factory.stages.place.completion.nelder_mead import minimize_cost
from tableverse_factory.stages.place.completion.ray_misfit import (
    RaySample,
    compute_misfit,
    intersect_box,
    intersect_rounded_box,
)
from tableverse_factory.stages.place.view.object_view import ObjectView

MIN_SIDE_M, MAX_SIDE_M = 0.003, 2.0
CARRY_WEIGHT = 0.02
EDGES_ON_LONGEST_SIDE = 20
STEPS = np.array([0.006, 0.006, 0.06, 0.06, 0.04, 0.06])  # of the search: middle [m], logarithms of sides, yaw [rad]
CALLS, ROUND_CALLS = 240, 130  # of each search for a box, and for its rounded edges
# Radius of rounded edges, as a share of half the shorter side: at the start and of a step of the search, at least, and
# at most, as what is rounder is turned
ROUND_START, ROUND_STEP, LEAST_ROUND, MOST_ROUND = 0.7, -0.4, 0.3, 0.8
SEGMENTS = 24  # of a whole turn
PRIOR_M = 2e-4  # weight of the prior on unobserved sides: small against the evidence of a single pixel column [m]


@dataclass(frozen=True, slots=True, eq=False)
class SolidBox(Frozen):
    """A box: its frame at the centre, along its sides, in the table frame; half sizes and misfit to the picture [m].

    `radius` is that of its edges along z [m], 0 of sharp ones and less than half of either side.
    """

    pose: Pose
    half_size: Vector3
    misfit: float
    radius: float = 0.0


def fit_upright_box(view: ObjectView, rays: RaySample) -> SolidBox:
    """Fit the best box that stands flat on the object's support."""
    return min((_fit_upright(view, rays, yaw) for yaw in _propose_yaws(view)), key=lambda box: box.misfit)


def round_edges(view: ObjectView, rays: RaySample, box: SolidBox) -> SolidBox | None:
    """Fit the best box with rounded upright edges, started from one with sharp edges; None if they stay nearly so."""
    sides, yaw = 2 * box.half_size, 2 * float(np.arctan2(box.pose.quaternion_wxyz[3], box.pose.quaternion_wxyz[0]))
    start = np.array([*box.pose.position[:2], *np.log(sides), yaw, ROUND_START])

    def decode(x: Float64[np.ndarray, "7"]) -> tuple[Vector3, Matrix3, Vector3, float]:
        position, rotation, half = _decode_box(x[:6], view.support_z)
        return position, rotation, half, float(min(max(x[6], 0.0), MOST_ROUND) * half[:2].min())

    def cost(x: Float64[np.ndarray, "7"]) -> float:
        position, rotation, half, radius = decode(x)
        misfit = compute_misfit(rays, intersect_rounded_box(rays, position, rotation, half, radius))
        return misfit + _penalize_uncarried(view, position, rotation, half)

    steps = np.array([*2.0 * STEPS, ROUND_STEP])  # with shorter ones, twice as many calls end 0.1 mm above, in the mean
    found = minimize_cost(cost, start, steps, ROUND_CALLS)
    found = minimize_cost(cost, found, -steps, ROUND_CALLS)  # other steps leave minima in which it stuck
    position, rotation, half, radius = decode(found)
    if radius < LEAST_ROUND * half[:2].min():
        return None
    misfit = compute_misfit(rays, intersect_rounded_box(rays, position, rotation, half, radius))
    return SolidBox(Pose(position, quaternion_about_z(float(found[5]))), half, misfit, radius)


def build_box_mesh(box: SolidBox) -> TriangleMesh:
    """Build the box in its own frame, its faces divided so that vertex colours can show the picture."""
    size = 2 * box.half_size
    core = size[:2] - 2 * box.radius
    section = CrossSection.square((float(core[0]), float(core[1])), True)
    if box.radius > 0.0:
        section = section.offset(box.radius, JoinType.Round, circular_segments=SEGMENTS)
    solid = Manifold.extrude(section, float(size[2])).translate((0.0, 0.0, -float(box.half_size[2])))
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

    found = minimize_cost(cost, start, STEPS, CALLS)
    position, rotation, half = _decode_box(found, view.support_z)
    misfit = compute_misfit(rays, intersect_box(rays, position, rotation, half))
    return SolidBox(Pose(position, quaternion_about_z(float(found[5]))), half, misfit)


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
