"""Registration of a mesh without pose or size to the points of one view (paper section 3.1).

Coarse: `starts`, the best of all headings of each face that can be down, by what `fit_price` says. Fine: `alignment`,
from these few to some of the points, and from the best of them to more.
"""

from dataclasses import dataclass, replace

import numpy as np

from schemas.geometry import Frozen, Points, Pose, TriangleMesh, Vector3
from schemas.objects import FitUncertainty
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.transforms import quaternion_from_matrix, rotation_matrix
from tableverse_factory.geometry.mesh.meshes import box_center
from tableverse_factory.geometry.mesh.surface_samples import distance_to_surface, surface_area
from tableverse_factory.geometry.registration.fit_cost import PROPORTIONS_STD, UPRIGHT, chamfer_costs
from tableverse_factory.geometry.registration.icp import (
    Fit,
    PartialView,
    Sampled,
    pose_covariance,
    run_icp,
    sampled,
    subsample,
)
from tableverse_factory.geometry.registration.initial_poses import initial_poses
from tableverse_factory.geometry.registration.symmetry import heading_folds, nearest_alike

LEAST_POINTS = 10
LEAST_BREADTH_M = 1e-4
"""Of points across the line that fits them best, root mean square."""
SAMPLES = 3000
MIDDLE_POINTS, FINE_POINTS, RESIDUAL_POINTS = 400, 1200, 1000
MIDDLE_STEPS, FINE_STEPS = 15, 20
MIDDLE_SETTLED, FINE_SETTLED = 6e-4, 2e-4
"""A step smaller than this is the last [m, rad]."""
REFINED = 2
"""So many starts are aligned to more points."""
DISTINCT = 0.03
"""Two placements are distinct where their surfaces lie this far apart, over the longest side."""
ALIKE_PRICE = 1.05
"""Price of a fit turned by a symmetry over that of the fit, up to which the view does not tell them apart."""
COMPLETED_STD = 0.08
"""Error of the proportions of a completion from one view, whose far side is guessed; see `PROPORTIONS_STD`."""
STANDS_STD_M = 0.0015
"""Of the height of the table, or of another object's top."""


@dataclass(frozen=True, slots=True, eq=False)
class Registration(Frozen):
    """Where a mesh stands, how large, and how sure that is.

    Attributes:
        pose: The mesh's own frame in the table frame, after `size`.
        size: Factor along each of the mesh's own axes. Shape (3,).
        uncertainty: Of the pose.
    """

    pose: Pose
    size: Vector3
    uncertainty: FitUncertainty


def register(mesh: TriangleMesh, view: PartialView) -> Registration:
    """Heading, position and size of a mesh from one view.

    Args:
        mesh: In its own frame, z up as it usually stands; any unit.
        view: Of the object.

    Raises:
        GeometryError: if there are too few points or they lie on a line, if the mesh has no surface, or if either is
            not finite.
    """
    _check(mesh, view.points)
    middle = box_center(mesh)
    ours = sampled(mesh, middle)
    folds = [heading_folds(ours.points, ours.tree, axis) for axis in range(3)]
    fits = _refined(ours, view, initial_poses(ours, view, folds))
    best = _nearest(ours, view, fits[0][0], folds)
    return Registration(
        Pose(best.shift - best.rotation @ (best.size * middle), quaternion_from_matrix(best.rotation)),
        best.size,
        _uncertainty(ours, view, best, _ambiguity(ours, fits), PROPORTIONS_STD),
    )


def uncertainty_of(mesh: TriangleMesh, pose: Pose, view: PartialView) -> FitUncertainty:
    """How sure the pose of a mesh is that was not registered but made where it stands.

    Args:
        mesh: In its own frame, metric.
        pose: Its own frame in the table frame.
        view: Of the object.
    """
    middle = box_center(mesh)
    rotation = rotation_matrix(pose.quaternion_wxyz)
    fit = Fit(rotation, np.ones(3), pose.position + rotation @ middle)
    # Its outline was carved from the same empty space, which therefore cannot vouch for it.
    points_alone = replace(view, emptiness=lambda points: np.ones(len(points)))
    return _uncertainty(sampled(mesh, middle), points_alone, fit, 0.0, COMPLETED_STD)


def median_distance(points: Points, mesh: TriangleMesh) -> float:
    """Median distance from the points to the surface [m]."""
    return float(np.median(distance_to_surface(subsample(points, RESIDUAL_POINTS), mesh, SAMPLES)))


def _check(mesh: TriangleMesh, points: Points) -> None:
    if not (np.isfinite(points).all() and np.isfinite(mesh.vertices).all()):
        raise GeometryError("a point to register to, or a vertex of the mesh, is not finite")
    if len(points) < LEAST_POINTS:
        raise GeometryError(f"{len(points)} points are too few to register a mesh; at least {LEAST_POINTS} are needed")
    breadth = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(points))
    if breadth < LEAST_BREADTH_M:
        raise GeometryError(f"the {len(points)} points to register to lie on a line")
    if not surface_area(mesh) > 0.0:
        raise GeometryError("the mesh has no surface")


def _refined(mesh: Sampled, view: PartialView, begun: list[Fit]) -> list[tuple[Fit, float]]:
    """The starts aligned to some of the points, the best of them to more; with their prices, the best first."""

    def ordered(begun: list[Fit], count: int, steps: int, settled: float) -> list[tuple[Fit, float]]:
        some = replace(view, points=subsample(view.points, count))
        fits = [run_icp(mesh, some, start, steps, settled, PROPORTIONS_STD) for start in begun]
        return sorted(
            zip(fits, chamfer_costs(mesh, view, fits, some.points).tolist(), strict=True), key=lambda fit: fit[1]
        )

    tried = ordered(begun, MIDDLE_POINTS, MIDDLE_STEPS, MIDDLE_SETTLED)
    return ordered([fit for fit, _ in tried[:REFINED]], FINE_POINTS, FINE_STEPS, FINE_SETTLED) + tried[REFINED:]


def _nearest(mesh: Sampled, view: PartialView, fit: Fit, folds: list[int]) -> Fit:
    """Of the fits that look like this one, and agree with the view as well, the one whose frame is turned least.

    So the answer for a symmetric shape does not hang on noise.
    """
    axis = _upright_axis(fit)
    if axis is None or folds[axis] == 1:
        return fit
    turn = nearest_alike(fit.rotation, folds[axis], axis)
    other = Fit(fit.rotation @ turn, np.diag(turn.T @ np.diag(fit.size) @ turn), fit.shift)
    its, price = chamfer_costs(mesh, view, [fit, other], subsample(view.points, FINE_POINTS))
    return other if price <= ALIKE_PRICE * its else fit


def _upright_axis(fit: Fit) -> int | None:
    """The mesh's own axis that is upright, None where it leans."""
    upright = np.abs(fit.rotation[2])
    return int(np.argmax(upright)) if upright.max() > UPRIGHT else None


def _ambiguity(mesh: Sampled, fits: list[tuple[Fit, float]]) -> float:
    """Price of the best over that of the best other placement that is truly another, 0 where there is none."""
    best, price = fits[0]
    few = subsample(mesh.points, MIDDLE_POINTS)
    for other, its in fits[1:]:
        local = ((few * other.size) @ other.rotation.T + other.shift - best.shift) @ best.rotation / best.size
        if float(np.sqrt((mesh.tree.query(local)[0] ** 2).mean())) > DISTINCT * mesh.length:
            return min(1.0, price / max(its, 1e-9))
    return 0.0


def _uncertainty(
    mesh: Sampled, view: PartialView, fit: Fit, ambiguity: float, proportions_std: float
) -> FitUncertainty:
    some = replace(view, points=subsample(view.points, FINE_POINTS))
    position, heading = pose_covariance(mesh, some, fit, proportions_std)
    axis = _upright_axis(fit)
    folds = 1 if axis is None else heading_folds(mesh.points, mesh.tree, axis)
    return FitUncertainty(position, heading if folds else None, folds, ambiguity)
