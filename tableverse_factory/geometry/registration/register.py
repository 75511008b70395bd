"""Registration of a mesh without pose or size to the points of one view, from coarse to fine (paper section 3.1)."""

from dataclasses import dataclass, replace

import numpy as np

from schemas.geometry import Frozen, Points, Pose, TriangleMesh, Vector3
from schemas.objects import FitUncertainty
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.transforms import quaternion_from_matrix, rotation_matrix
from tableverse_factory.geometry.mesh.meshes import box_center
from tableverse_factory.geometry.mesh.surface_samples import compute_surface_area, measure_distance_to_surface
from tableverse_factory.geometry.registration.fit_cost import PROPORTIONS_STD, UPRIGHT, compute_chamfer_costs
from tableverse_factory.geometry.registration.icp import (
    Fit,
    PartialView,
    SampledMesh,
    estimate_pose_std,
    run_icp,
    sample_mesh,
    subsample,
)
from tableverse_factory.geometry.registration.initial_poses import find_initial_poses
from tableverse_factory.geometry.registration.symmetry import count_heading_folds, find_symmetry_turn

MIN_POINTS = 10
MIN_BREADTH_M = 1e-4  # of points across the line that fits them best, root mean square
SAMPLES = 3000
MIDDLE_POINTS, FINE_POINTS, RESIDUAL_POINTS = 400, 1200, 1000
MIDDLE_STEPS, FINE_STEPS = 15, 20
MIDDLE_SETTLED, FINE_SETTLED = 6e-4, 2e-4  # ICP ends with a step smaller than this [m, rad]
REFINED_STARTS = 2  # starts that are aligned to more points
DISTINCT = 0.03  # two placements are distinct where their surfaces lie this far apart, over the longest side
ALIKE_COST_RATIO = 1.05  # up to this ratio of costs the view does not distinguish a fit from one turned by a symmetry
COMPLETED_STD = 0.08  # `PROPORTIONS_STD` of a completion from one view, whose far side is guessed
STANDS_STD_M = 0.0015  # of the height of the table, or of another object's top


@dataclass(frozen=True, slots=True, eq=False)
class Registration(Frozen):
    """Factors along the mesh's own axes, then the pose of its own frame in the table frame, with its uncertainty."""

    pose: Pose
    size: Vector3
    uncertainty: FitUncertainty


def register(mesh: TriangleMesh, view: PartialView) -> Registration:
    """Estimate pose and size of a mesh from one view; its own frame has z up as it usually stands, and any unit.

    Raises:
        GeometryError: if there are too few points or they lie on a line, if the mesh has no surface, or if either is
            not finite.
    """
    _check_inputs(mesh, view.points)
    middle = box_center(mesh)
    ours = sample_mesh(mesh, middle)
    folds = [count_heading_folds(ours.points, ours.tree, axis) for axis in range(3)]
    fits = _refine(ours, view, find_initial_poses(ours, view, folds))
    best = _resolve_symmetry(ours, view, fits[0][0], folds)
    return Registration(
        Pose(best.shift - best.rotation @ (best.size * middle), quaternion_from_matrix(best.rotation)),
        best.size,
        _estimate_fit_uncertainty(ours, view, best, _compute_ambiguity(ours, fits), PROPORTIONS_STD),
    )


def estimate_uncertainty(mesh: TriangleMesh, pose: Pose, view: PartialView) -> FitUncertainty:
    """Estimate the uncertainty of a metric mesh that was not registered but made in place, at `pose` on the table."""
    middle = box_center(mesh)
    rotation = rotation_matrix(pose.quaternion_wxyz)
    fit = Fit(rotation, np.ones(3), pose.position + rotation @ middle)
    # Its outline was carved from the same free space, which is therefore no evidence.
    points_alone = replace(view, emptiness=lambda points: np.ones(len(points)))
    return _estimate_fit_uncertainty(sample_mesh(mesh, middle), points_alone, fit, 0.0, COMPLETED_STD)


def measure_median_distance(points: Points, mesh: TriangleMesh) -> float:
    """Measure the median distance from the points to the surface [m]."""
    return float(np.median(measure_distance_to_surface(subsample(points, RESIDUAL_POINTS), mesh, SAMPLES)))


def _check_inputs(mesh: TriangleMesh, points: Points) -> None:
    if not (np.isfinite(points).all() and np.isfinite(mesh.vertices).all()):
        raise GeometryError("a point to register to, or a vertex of the mesh, is not finite")
    if len(points) < MIN_POINTS:
        raise GeometryError(f"{len(points)} points are too few to register a mesh; at least {MIN_POINTS} are needed")
    breadth = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(points))
    if breadth < MIN_BREADTH_M:
        raise GeometryError(f"the {len(points)} points to register to lie on a line")
    if not compute_surface_area(mesh) > 0.0:
        raise GeometryError("the mesh has no surface")


def _refine(mesh: SampledMesh, view: PartialView, begun: list[Fit]) -> list[tuple[Fit, float]]:
    """Align the starts to some of the points, the best of them to more; with their costs, the best first."""

    def ordered(begun: list[Fit], count: int, steps: int, settled: float) -> list[tuple[Fit, float]]:
        some = replace(view, points=subsample(view.points, count))
        fits = [run_icp(mesh, some, start, steps, settled, PROPORTIONS_STD) for start in begun]
        costs = compute_chamfer_costs(mesh, view, fits, some.points).tolist()
        return sorted(zip(fits, costs, strict=True), key=lambda fit: fit[1])

    tried = ordered(begun, MIDDLE_POINTS, MIDDLE_STEPS, MIDDLE_SETTLED)
    best = ordered([fit for fit, _ in tried[:REFINED_STARTS]], FINE_POINTS, FINE_STEPS, FINE_SETTLED)
    return best + tried[REFINED_STARTS:]


def _resolve_symmetry(mesh: SampledMesh, view: PartialView, fit: Fit, folds: list[int]) -> Fit:
    """Choose the symmetric equivalent that agrees with the view and is turned least, so that noise does not decide."""
    axis = _find_upright_axis(fit)
    if axis is None or folds[axis] == 1:
        return fit
    turn = find_symmetry_turn(fit.rotation, folds[axis], axis)
    other = Fit(fit.rotation @ turn, np.diag(turn.T @ np.diag(fit.size) @ turn), fit.shift)
    its, price = compute_chamfer_costs(mesh, view, [fit, other], subsample(view.points, FINE_POINTS))
    return other if price <= ALIKE_COST_RATIO * its else fit


def _find_upright_axis(fit: Fit) -> int | None:
    """Find the mesh's own axis that is upright, None where it leans."""
    upright = np.abs(fit.rotation[2])
    return int(np.argmax(upright)) if upright.max() > UPRIGHT else None


def _compute_ambiguity(mesh: SampledMesh, fits: list[tuple[Fit, float]]) -> float:
    """Compute the cost of the best over that of the best distinct placement, 0 where there is none."""
    best, price = fits[0]
    few = subsample(mesh.points, MIDDLE_POINTS)
    for other, its in fits[1:]:
        local = ((few * other.size) @ other.rotation.T + other.shift - best.shift) @ best.rotation / best.size
        if float(np.sqrt((mesh.tree.query(local)[0] ** 2).mean())) > DISTINCT * mesh.length:
            return min(1.0, price / max(its, 1e-9))
    return 0.0


def _estimate_fit_uncertainty(
    mesh: SampledMesh, view: PartialView, fit: Fit, ambiguity: float, proportions_std: float
) -> FitUncertainty:
    some = replace(view, points=subsample(view.points, FINE_POINTS))
    position, heading = estimate_pose_std(mesh, some, fit, proportions_std)
    axis = _find_upright_axis(fit)
    folds = 1 if axis is None else count_heading_folds(mesh.points, mesh.tree, axis)
    return FitUncertainty(position, heading if folds else None, folds, ambiguity)
