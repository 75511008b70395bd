"""Registration of a mesh without pose or size to the points of one view (paper section 3.1).

Coarse: for each face that can be down, the headings on a grid, then a continuous search about the best of them, and the
ways in which the longest sides of mesh and points fall together. The price is the Chamfer distance for a partial view:
from each observed point to the mesh, and from the mesh to where it could hide, as far as it reaches into space that was
seen to be empty; what nothing was seen of is free. Fine: `alignment`, from the few best starts.

A shape that looks alike at several headings is only searched over one of them, the nearest to its own, so that its
answer does not hang on noise.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize_scalar
from scipy.spatial import cKDTree

from schemas.geometry import Frozen, Matrix3, Points, Pose, TriangleMesh, Vector3
from schemas.objects import FitUncertainty
from tableverse_factory.errors import GeometryError
from tableverse_factory.geometry.alignment import Emptiness, Fit, Sampled, Seen, aligned, deviations, sampled
from tableverse_factory.geometry.meshes import box_center
from tableverse_factory.geometry.samples import distance_to_surface
from tableverse_factory.geometry.symmetry import heading_folds, turn_about
from tableverse_factory.geometry.transforms import quaternion_from_matrix, rotation_matrix

SAMPLES = 3000
COARSE_POINTS = 150
MIDDLE_POINTS = 400
FINE_POINTS = 1200
RESIDUAL_POINTS = 1000
HEADING_STEP = float(np.deg2rad(5.0))
TIPPED_STEP = float(np.deg2rad(15.0))
TRIED, USUAL, REFINED = 7, 3, 2
"""Starts that are aligned to some of the points, of them on the mesh's own lower face; and to more points."""
MIDDLE_STEPS, FINE_STEPS = 15, 20
ODD_PRICE_M = 0.001
"""A mesh that lies on another than its own lower face has to fit this much better."""
STRETCHED_M = 0.0001
"""Price of proportions that are wrong by one standard deviation."""
UPRIGHT = 0.9
"""Cosine of the tilt up to which a mesh stands on its own lower face."""
FARTHEST_M = 0.02
UNSEEN_WEIGHT = 0.15
"""Of the way from the mesh to the points, where nobody says what space is empty."""
FLOATS, KNOWN_SUPPORT_M = 0.1, 0.005
"""Price of a metre between a mesh and its support, and how well this has to be known for that."""
EMPTY_SLACK_M = 0.002
BELOW_TABLE_M = 0.003
APART_RAD, OTHER_SIZE = 0.3, 0.1
DISTINCT = 0.03
"""Two placements are distinct where their surfaces lie this far apart, over the longest side."""
PROPORTIONS_STD = 0.04
"""A MeshModel's error of the proportions: of the logarithm of the size along one axis against the others."""

COMPLETED_STD = 0.08
"""The same of a completion from one view, whose far side is guessed."""
STANDS_STD_M = 0.0015
"""Of the height of the table, or of another object's top."""


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
    support_std_m: float
    emptiness: Emptiness | None
    tree: cKDTree


def register(
    mesh: TriangleMesh,
    points: Points,
    eye: Vector3,
    support_z: float,
    support_std_m: float = STANDS_STD_M,
    emptiness: Emptiness | None = None,
) -> Registration:
    """Heading, position and size of a mesh from the points of one view.

    Args:
        mesh: In its own frame, z up as it usually stands; any unit.
        points: Observed points, table frame [m]. Shape (n, 3).
        eye: Position of the camera, table frame [m].
        support_z: Height of what the object stands on [m].
        support_std_m: How well that is known: hardly in a container, whose floor is hidden [m].
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
    view = _View(points, thinned(points, COARSE_POINTS), eye, support_z, support_std_m, emptiness, cKDTree(points))
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
    mesh: TriangleMesh, pose: Pose, points: Points, support_z: float, support_std_m: float = STANDS_STD_M
) -> FitUncertainty:
    """How sure the pose of a mesh is that was not registered but made where it stands.

    Args:
        mesh: In its own frame, metric.
        pose: Its own frame in the table frame.
        points: Observed, table frame [m]. Shape (n, 3).
        support_z: Height of what it stands on [m].
        support_std_m: How well that is known [m].
    """
    middle = box_center(mesh)
    rotation = rotation_matrix(pose.quaternion_wxyz)
    fit = Fit(rotation, np.ones(3), pose.position + rotation @ middle)
    view = _View(points, points, np.zeros(3), support_z, support_std_m, None, cKDTree(points))
    return _uncertainty(sampled(mesh, middle), view, fit, 0.0, COMPLETED_STD)


def median_distance(points: Points, mesh: TriangleMesh) -> float:
    """Median distance from the points to the surface [m]."""
    return float(np.median(distance_to_surface(thinned(points, RESIDUAL_POINTS), mesh, SAMPLES)))


def thinned(points: Points, count: int) -> Points:
    """About `count` of the points, evenly over their order."""
    few: Points = points[:: max(1, len(points) // count)]
    return few


def _starts(mesh: Sampled, view: _View) -> list[Fit]:
    """The best few starts of all kinds, no two of them alike."""
    priced = sorted(((_price(mesh, view, fit), fit) for fit in _guesses(mesh, view)), key=lambda entry: entry[0])
    if not priced:
        raise GeometryError("no heading of the mesh faces the camera")
    usual = [entry for entry in priced if entry[1].rotation[2, 2] > UPRIGHT]
    chosen = _apart([*_apart(usual, USUAL), *priced], TRIED)
    return [_polished(mesh, view, fit) for _, fit in chosen]


def _guesses(mesh: Sampled, view: _View) -> Iterator[Fit]:
    """Starts over all headings of each face that can be down, and over the ways the longest sides fall together."""
    folds = [heading_folds(mesh.points, mesh.tree, axis) for axis in range(3)]
    for index, (down, axis) in enumerate(_downs()):
        step = TIPPED_STEP if index else HEADING_STEP
        for heading in _headings(folds[axis], step):
            yield from _standing(mesh, view, turn_about(2, heading) @ down)
    yield from _along(mesh, view)


def _headings(folds: int, step: float) -> Float64[np.ndarray, " n"]:
    """The headings of one of `folds` equal parts of the circle, about the mesh's own."""
    if folds == 0:
        return np.zeros(1)
    count = max(1, round(2 * np.pi / folds / step))
    part: Float64[np.ndarray, " n"] = 2 * np.pi / folds * (np.arange(count) / count)
    return np.sort(np.where(part > np.pi / folds, part - 2 * np.pi / folds, part))


def _standing(mesh: Sampled, view: _View, rotation: Matrix3) -> Iterator[Fit]:
    """Size from the height and, where that says something else, from the breadth; position from what faces the camera.

    A sheet has next to no height to tell its size by, and of what is partly hidden the breadth is too small.
    """
    turned = mesh.points @ rotation.T
    seen = (mesh.normals @ rotation.T) @ (view.eye - view.points.mean(axis=0)) > 0.0
    extent = np.ptp(turned, axis=0)
    if seen.sum() < 10 or not np.hypot(extent[0], extent[1]) > 0.0:
        return
    low, high = np.quantile(view.points, 0.01, axis=0), np.quantile(view.points, 0.99, axis=0)
    by_breadth = float(np.hypot(*(high - low)[:2]) / np.hypot(*extent[:2]))
    top = float(np.quantile(view.points[:, 2], 0.995))
    by_height = max(top - view.support_z, 1e-3) / max(float(extent[2]), 1e-3 * mesh.length)
    sizes = [float(np.clip(by_height, 0.5 * by_breadth, 2.5 * by_breadth))]
    if abs(np.log(by_breadth / sizes[0])) > OTHER_SIZE:
        sizes.append(by_breadth)
    for size in sizes:
        visible = turned[seen] * size
        shift = (low + high) / 2 - (visible.min(axis=0) + visible.max(axis=0)) / 2
        shift[2] = view.support_z - size * float(turned[:, 2].min())
        yield Fit(rotation, np.full(3, size), shift)


def _along(mesh: Sampled, view: _View) -> Iterator[Fit]:
    """Starts with the principal axes of the mesh along those of the points, as long as these or down to the support."""
    ours, theirs = _principal(mesh.points), _principal(view.points)
    if theirs[2, 0] < 0.0:
        theirs = theirs @ np.diag([-1.0, -1.0, 1.0])
    middle = view.points.mean(axis=0)
    low, high = np.quantile((view.points - middle) @ theirs[:, 0], (0.01, 0.99))
    along = mesh.points @ ours[:, 0]
    reach = float(middle[2] + high * theirs[2, 0] - view.support_z) / max(float(theirs[2, 0]), 0.5)
    for length in dict.fromkeys((float(high - low), max(float(high - low), reach))):
        size = length / float(np.ptp(along))
        center = middle + theirs[:, 0] * (high - length / 2)
        for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
            rotation = theirs @ np.diag(signs) @ ours.T
            inner = ours[:, 0] * (along.min() + along.max()) / 2
            yield Fit(rotation, np.full(3, size), center - rotation @ (size * inner))


def _principal(points: Points) -> Matrix3:
    """Right-handed axes in columns, the longest first."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1][:, ::-1].copy()
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return axes


def _polished(mesh: Sampled, view: _View, start: Fit) -> Fit:
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
    return turned(float(found.x))


def _price(mesh: Sampled, view: _View, fit: Fit, points: Points | None = None) -> float:
    """Chamfer distance for a partial view, and what an unusual stand costs [m]."""
    asked = view.few if points is None else points
    there = mesh.tree.query((asked - fit.shift) @ fit.rotation / fit.size)[0] * float(fit.size.mean())
    price = float(np.minimum(there, FARTHEST_M).mean())
    body = (thinned(mesh.points, 2 * COARSE_POINTS) * fit.size) @ fit.rotation.T + fit.shift
    price += float(np.clip(-body[:, 2] - BELOW_TABLE_M, 0.0, FARTHEST_M).mean())
    floats = min(abs(float(body[:, 2].min()) - view.support_z), FARTHEST_M)
    price += FLOATS * floats * min(1.0, KNOWN_SUPPORT_M / view.support_std_m)
    if view.emptiness is None:
        price += UNSEEN_WEIGHT * float(np.minimum(view.tree.query(body)[0], FARTHEST_M).mean())
    else:
        price += 2.0 * float(np.clip(-view.emptiness(body) - EMPTY_SLACK_M, 0.0, FARTHEST_M).mean())
    stretch = np.log(fit.size) - np.log(fit.size).mean()
    price += STRETCHED_M * float((stretch**2).sum()) / PROPORTIONS_STD**2
    return price + (0.0 if fit.rotation[2, 2] > UPRIGHT else ODD_PRICE_M)


def _apart(priced: list[tuple[float, Fit]], count: int) -> list[tuple[float, Fit]]:
    """The first `count` of a list, without those that are turned and as large as one before."""
    chosen: list[tuple[float, Fit]] = []
    alike = 1.0 + 2.0 * np.cos(APART_RAD)
    for entry in priced:
        fit = entry[1]
        if all(
            np.trace(fit.rotation.T @ other.rotation) < alike or abs(np.log(fit.size[0] / other.size[0])) > OTHER_SIZE
            for _, other in chosen
        ):
            chosen.append(entry)
        if len(chosen) == count:
            break
    return chosen


def _refined(mesh: Sampled, view: _View, starts: list[Fit]) -> list[tuple[Fit, float]]:
    """The starts aligned to some of the points, the best of them to more; with their prices, the best first."""

    def ordered(starts: list[Fit], points: Points, steps: int) -> list[tuple[Fit, float]]:
        seen = Seen(points, view.support_z, view.support_std_m, PROPORTIONS_STD, view.emptiness)
        fits = [aligned(mesh, seen, start, steps) for start in starts]
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
    seen = Seen(points, view.support_z, view.support_std_m, proportions_std, view.emptiness)
    position, heading = deviations(mesh, seen, fit)
    up = fit.rotation[2]
    axis = int(np.argmax(np.abs(up)))
    folds = heading_folds(mesh.points, mesh.tree, axis) if abs(up[axis]) > UPRIGHT else 1
    return FitUncertainty(position, heading if folds else None, folds, ambiguity)


def _downs() -> list[tuple[Matrix3, int]]:
    """Rotations that put each of the six faces of a box down, the mesh's own first; and its axis that is upright."""
    x, y = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    flip = np.diag([1.0, -1.0, -1.0])
    return [(np.eye(3), 2), (flip, 2), (x, 0), (x.T, 0), (y, 1), (y.T, 1)]
