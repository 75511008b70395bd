"""Registration of a mesh without pose or size to the points of one view (paper section 3.1).

Coarse: for each face that can be down, the headings on a grid, then a continuous search about the best of them, and the
ways in which the longest sides of mesh and points fall together. The price is the Chamfer distance for a partial view:
from each observed point to the mesh, and from the mesh to where it could hide, as far as it reaches into space that was
seen to be empty; what nothing was seen of is free. Fine: `alignment`, from the few best starts.

A shape that looks alike at several headings is only searched over one of them, the nearest to its own, so that its
answer does not hang on noise.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize_scalar

from schemas.geometry import Frozen, Matrix3, Points, Pose, TriangleMesh, Vector3
from schemas.objects import FitUncertainty
from tableverse_factory.errors import GeometryError
from tableverse_factory.geometry.alignment import Fit, Sampled, aligned, deviations, sampled
from tableverse_factory.geometry.meshes import box_center
from tableverse_factory.geometry.samples import distance_to_surface
from tableverse_factory.geometry.symmetry import heading_folds, turn_about
from tableverse_factory.geometry.transforms import quaternion_from_matrix, rotation_matrix

SAMPLES = 3000
COARSE_POINTS = 150
MIDDLE_POINTS = 400
FINE_POINTS = 2000
RESIDUAL_POINTS = 1000
HEADING_STEP = float(np.deg2rad(5.0))
TIPPED_STEP = float(np.deg2rad(15.0))
POLISHED, TRIED, REFINED = 8, 6, 2
MIDDLE_STEPS, FINE_STEPS = 20, 30
ODD_PRICE_M = 0.001
"""A mesh that lies on another than its own lower face has to fit this much better."""
UPRIGHT = 0.9
"""Cosine of the tilt up to which a mesh stands on its own lower face."""
FARTHEST_M = 0.02
EMPTY_SLACK_M = 0.001
BELOW_TABLE_M = 0.003
APART_RAD = 0.3
DISTINCT = 0.03
"""Two placements are distinct where their surfaces lie this far apart, over the longest side."""
PROPORTIONS_STD = 0.04
"""A MeshModel's error of the proportions: of the logarithm of the size along one axis against the others."""

Emptiness = Callable[[Points], Float64[np.ndarray, " n"]]
"""How far each point lies from space that was seen to be empty [m], negative inside of it."""


@dataclass(frozen=True, slots=True, eq=False)
class Registration(Frozen):
    """Where a mesh stands, how large, and how sure that is.

    Attributes:
        pose: The mesh's own frame in the table frame, after `size`.
        size: Factor along each of the mesh's own axes. Shape (3,).
        residual_m: Median distance from the observed points to the placed mesh.
        uncertainty: Of the pose.
    """

    pose: Pose
    size: Vector3
    residual_m: float
    uncertainty: FitUncertainty


@dataclass(frozen=True, slots=True, eq=False)
class _View(Frozen):
    """What one view says."""

    points: Points
    few: Points
    eye: Vector3
    support_z: float
    emptiness: Emptiness | None


def register(
    mesh: TriangleMesh, points: Points, eye: Vector3, support_z: float, emptiness: Emptiness | None = None
) -> Registration:
    """Heading, position and size of a mesh from the points of one view.

    Args:
        mesh: In its own frame, z up as it usually stands; any unit.
        points: Observed points, table frame [m]. Shape (n, 3).
        eye: Position of the camera, table frame [m].
        support_z: Height of what the object stands on [m].
        emptiness: Of the same view, table frame; without it, only the points decide.

    Raises:
        GeometryError: if there are too few points or the mesh has no extent.
    """
    if len(points) < 10:
        raise GeometryError(f"{len(points)} points are too few to register a mesh; at least 10 are needed")
    middle = box_center(mesh)
    ours = sampled(mesh, middle)
    if not ours.length > 0.0:
        raise GeometryError("the mesh has no extent")
    view = _View(points, thinned(points, COARSE_POINTS), eye, support_z, emptiness)
    fits = _refined(ours, view, _starts(ours, view))
    best = fits[0][0]
    shift = best.shift - best.rotation @ (best.size * middle)
    placed = TriangleMesh((mesh.vertices * best.size) @ best.rotation.T + shift, mesh.faces)
    return Registration(
        Pose(shift, quaternion_from_matrix(best.rotation)),
        best.size,
        median_distance(points, placed),
        _uncertainty(ours, view, best, _ambiguity(ours, fits), PROPORTIONS_STD),
    )


def uncertainty_of(
    mesh: TriangleMesh, pose: Pose, points: Points, support_z: float, proportions_std: float
) -> FitUncertainty:
    """How sure the pose of a mesh is that was not registered but made where it stands.

    Args:
        mesh: In its own frame, metric.
        pose: Its own frame in the table frame.
        points: Observed, table frame [m]. Shape (n, 3).
        support_z: Height of what it stands on [m].
        proportions_std: How far its sides may be wrong where nothing is seen of them, as a share.
    """
    middle = box_center(mesh)
    rotation = rotation_matrix(pose.quaternion_wxyz)
    fit = Fit(rotation, np.ones(3), pose.position + rotation @ middle)
    view = _View(points, points, np.zeros(3), support_z, None)
    return _uncertainty(sampled(mesh, middle), view, fit, 0.0, proportions_std)


def median_distance(points: Points, mesh: TriangleMesh) -> float:
    """Median distance from the points to the surface [m]."""
    return float(np.median(distance_to_surface(thinned(points, RESIDUAL_POINTS), mesh, SAMPLES)))


def thinned(points: Points, count: int) -> Points:
    """About `count` of the points, evenly over their order."""
    few: Points = points[:: max(1, len(points) // count)]
    return few


def _starts(mesh: Sampled, view: _View) -> list[Fit]:
    """The best few starts of all kinds, no two of them alike."""
    priced = sorted(((_price(mesh, view, fit), fit, down) for fit, down in _guesses(mesh, view)), key=lambda p: p[0])
    if not priced:
        raise GeometryError("no heading of the mesh faces the camera")
    polished = [_polished(mesh, view, fit, down) for _, fit, down in _apart(priced, POLISHED)]
    return [fit for _, fit, _ in _apart(sorted(polished, key=lambda p: p[0]), TRIED)]


def _guesses(mesh: Sampled, view: _View) -> Iterator[tuple[Fit, Matrix3]]:
    """Starts over all headings of each face that can be down, and over the ways the longest sides fall together."""
    folds = [heading_folds(mesh.points, mesh.tree, axis) for axis in range(3)]
    for index, (down, axis) in enumerate(_downs()):
        step = TIPPED_STEP if index else HEADING_STEP
        for heading in _headings(folds[axis], step):
            if (fit := _standing(mesh, view, turn_about(2, heading) @ down)) is not None:
                yield fit, down
    for fit in _along(mesh, view):
        yield fit, fit.rotation


def _headings(folds: int, step: float) -> Float64[np.ndarray, " n"]:
    """The headings of one of `folds` equal parts of the circle, about the mesh's own."""
    if folds == 0:
        return np.zeros(1)
    count = max(1, round(2 * np.pi / folds / step))
    part: Float64[np.ndarray, " n"] = 2 * np.pi / folds * (np.arange(count) / count)
    return np.sort(np.where(part > np.pi / folds, part - 2 * np.pi / folds, part))


def _standing(mesh: Sampled, view: _View, rotation: Matrix3) -> Fit | None:
    """Size from the height, position from the box of the side that faces the camera."""
    turned = mesh.points @ rotation.T
    seen = (mesh.normals @ rotation.T) @ (view.eye - view.points.mean(axis=0)) > 0.0
    height = float(np.ptp(turned[:, 2]))
    if seen.sum() < 10 or height <= 1e-6 * mesh.length:
        return None
    top = float(np.quantile(view.points[:, 2], 0.995))
    size = max(top - view.support_z, 1e-3) / height
    breadth = float(np.hypot(*np.ptp(view.points[:, :2], axis=0))) / float(np.hypot(*np.ptp(turned[:, :2], axis=0)))
    # A sheet has next to no height to tell its size by: its breadth does.
    size = float(np.clip(size, 0.5 * breadth, 2.5 * breadth))
    visible = turned[seen] * size
    low, high = np.quantile(view.points, 0.01, axis=0), np.quantile(view.points, 0.99, axis=0)
    shift = (low + high) / 2 - (visible.min(axis=0) + visible.max(axis=0)) / 2
    shift[2] = view.support_z - size * float(turned[:, 2].min())
    return Fit(rotation, np.full(3, size), shift)


def _along(mesh: Sampled, view: _View) -> Iterator[Fit]:
    """Starts with the principal axes of the mesh along those of the points: for what leans."""
    ours, theirs = _principal(mesh.points), _principal(view.points)
    middle = view.points.mean(axis=0)
    extent, length = np.ptp((view.points - middle) @ theirs[:, 0]), np.ptp(mesh.points @ ours[:, 0])
    for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
        rotation = theirs @ np.diag(signs) @ ours.T
        size = float(extent / length)
        shift = middle - rotation @ (size * mesh.points.mean(axis=0))
        yield Fit(rotation, np.full(3, size), shift)


def _principal(points: Points) -> Matrix3:
    """Right-handed axes in columns, the longest first."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1][:, ::-1].copy()
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return axes


def _polished(mesh: Sampled, view: _View, start: Fit, down: Matrix3) -> tuple[float, Fit, Matrix3]:
    """The best heading within a step of a start, by a continuous search."""

    def turned(angle: float) -> Fit:
        turn = turn_about(2, angle)
        pivot = view.few.mean(axis=0)
        return Fit(turn @ start.rotation, start.size, pivot + turn @ (start.shift - pivot))

    reach = HEADING_STEP if start.rotation[2, 2] > UPRIGHT else TIPPED_STEP
    found = minimize_scalar(
        lambda angle: _price(mesh, view, turned(float(angle))),
        bounds=(-reach, reach),
        method="bounded",
        options={"maxiter": 8},
    )
    fit = turned(float(found.x))
    return float(found.fun), fit, down


def _price(mesh: Sampled, view: _View, fit: Fit, points: Points | None = None) -> float:
    """Chamfer distance for a partial view, and what an unusual stand costs [m]."""
    asked = view.few if points is None else points
    there = mesh.tree.query((asked - fit.shift) @ fit.rotation / fit.size)[0] * float(fit.size.mean())
    price = float(np.minimum(there, FARTHEST_M).mean())
    body = (thinned(mesh.points, 2 * COARSE_POINTS) * fit.size) @ fit.rotation.T + fit.shift
    price += float(np.clip(-body[:, 2] - BELOW_TABLE_M, 0.0, FARTHEST_M).mean())
    if view.emptiness is not None:
        price += 2.0 * float(np.clip(-view.emptiness(body) - EMPTY_SLACK_M, 0.0, FARTHEST_M).mean())
    return price + (0.0 if fit.rotation[2, 2] > UPRIGHT else ODD_PRICE_M)


def _apart(priced: list[tuple[float, Fit, Matrix3]], count: int) -> list[tuple[float, Fit, Matrix3]]:
    """The first `count` of a sorted list, without those that are turned like one before."""
    chosen: list[tuple[float, Fit, Matrix3]] = []
    alike = 1.0 + 2.0 * np.cos(APART_RAD)
    for entry in priced:
        if all(np.trace(entry[1].rotation.T @ other[1].rotation) < alike for other in chosen):
            chosen.append(entry)
        if len(chosen) == count:
            break
    return chosen


def _refined(mesh: Sampled, view: _View, starts: list[Fit]) -> list[tuple[Fit, float]]:
    """The starts aligned to some of the points, the best of them to more; with their prices, the best first."""

    def ordered(starts: list[Fit], points: Points, steps: int) -> list[tuple[Fit, float]]:
        fits = [aligned(mesh, points, start, view.support_z, PROPORTIONS_STD, steps) for start in starts]
        return sorted(((fit, _price(mesh, view, fit, points)) for fit in fits), key=lambda fit: fit[1])

    tried = ordered(starts, thinned(view.points, MIDDLE_POINTS), MIDDLE_STEPS)
    final = ordered([fit for fit, _ in tried[:REFINED]], thinned(view.points, FINE_POINTS), FINE_STEPS)
    return final + tried[REFINED:]


def _ambiguity(mesh: Sampled, fits: list[tuple[Fit, float]]) -> float:
    """Price of the best over that of the best other placement that is truly another, 0 where there is none."""
    best, price = fits[0]
    few = thinned(mesh.points, MIDDLE_POINTS)
    for other, its in fits[1:]:
        local = ((few * other.size) @ other.rotation.T + other.shift - best.shift) @ best.rotation / best.size
        if float(np.sqrt((mesh.tree.query(local)[0] ** 2).mean())) > DISTINCT * mesh.length:
            return min(1.0, price / max(its, 1e-9))
    return 0.0


def _uncertainty(mesh: Sampled, view: _View, fit: Fit, ambiguity: float, proportions_std: float) -> FitUncertainty:
    points = thinned(view.points, FINE_POINTS)
    position, heading = deviations(mesh, points, fit, view.support_z, proportions_std)
    up = fit.rotation[2]
    axis = int(np.argmax(np.abs(up)))
    folds = heading_folds(mesh.points, mesh.tree, axis) if abs(up[axis]) > UPRIGHT else 1
    return FitUncertainty(position, heading if folds else None, folds, ambiguity)


def _downs() -> list[tuple[Matrix3, int]]:
    """Rotations that put each of the six faces of a box down, the mesh's own first; and its axis that is upright."""
    x, y = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    flip = np.diag([1.0, -1.0, -1.0])
    return [(np.eye(3), 2), (flip, 2), (x, 0), (x.T, 0), (y, 1), (y.T, 1)]
