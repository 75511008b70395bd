"""Where a registration begins: a few rough placements of a mesh, no two of them alike (paper section 3.1).

For each face that can be down, the headings on a grid, then a continuous search about the best of them; and the ways in
which the longest sides of mesh and points fall together.

Of the headings at which a shape looks alike, only those nearest to its own are tried.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize_scalar

from schemas.geometry import Frozen, Matrix3, Points, Vector3
from tableverse_factory.geometry.registration.fit_cost import UPRIGHT, chamfer_costs
from tableverse_factory.geometry.registration.icp import Fit, PartialView, Sampled, subsample
from tableverse_factory.geometry.registration.symmetry import turn_about

POINTS = 150
HEADING_STEP = float(np.deg2rad(5.0))
TIPPED_STEP = float(np.deg2rad(15.0))
TRIED, USUAL = 7, 3
"""So many, and so many of them on the mesh's own lower face."""
APART_RAD, OTHER_SIZE = 0.3, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class _Spread(Frozen):
    """Where the observed points lie: their 1 % and 99 % quantiles, their middle and their top [m]."""

    low: Vector3
    high: Vector3
    middle: Vector3
    top: float


def initial_poses(mesh: Sampled, view: PartialView, folds: Sequence[int]) -> list[Fit]:
    """The best few starts of all kinds, no two of them alike.

    Args:
        mesh: What is registered.
        view: What it is registered to.
        folds: How many turns about each of the mesh's own axes leave it alike, 0 for all of them.
    """
    guesses = list(_guesses(mesh, view, folds))
    price = chamfer_costs(mesh, view, guesses, subsample(view.points, POINTS))
    ordered = [guesses[k] for k in np.argsort(price, kind="stable")]
    usual = [fit for fit in ordered if fit.rotation[2, 2] > UPRIGHT]
    return [_polished(mesh, view, fit) for fit in _apart([*_apart(usual, USUAL), *ordered], TRIED)]


def _guesses(mesh: Sampled, view: PartialView, folds: Sequence[int]) -> Iterator[Fit]:
    """Starts over all headings of each face that can be down, and over the ways the longest sides fall together."""
    low, high = np.quantile(view.points, (0.01, 0.99), axis=0)
    spread = _Spread(low, high, view.points.mean(axis=0), float(np.quantile(view.points[:, 2], 0.995)))
    for index, (down, axis) in enumerate(_downs()):
        step = TIPPED_STEP if index else HEADING_STEP
        for heading in _headings(folds[axis], step):
            yield from _standing(mesh, view, spread, turn_about(2, heading) @ down)
    yield from _along(mesh, view)


def _headings(folds: int, step: float) -> Float64[np.ndarray, " n"]:
    """The headings of one of `folds` equal parts of the circle, about the mesh's own."""
    if folds == 0:
        return np.zeros(1)
    count = max(1, round(2 * np.pi / folds / step))
    part: Float64[np.ndarray, " n"] = 2 * np.pi / folds * (np.arange(count) / count)
    return np.sort(np.where(part > np.pi / folds, part - 2 * np.pi / folds, part))


def _standing(mesh: Sampled, view: PartialView, spread: _Spread, rotation: Matrix3) -> Iterator[Fit]:
    """Size from the height and, where that says something else, from the breadth; position from what faces the camera.

    A sheet has next to no height to tell its size by, and of what is partly hidden the breadth is too small.
    """
    turned = rotation @ mesh.points.T
    seen = mesh.normals @ (rotation.T @ (view.eye - spread.middle)) > 0.0
    lowest = turned.min(axis=1)
    extent = turned.max(axis=1) - lowest
    if seen.sum() < 10 or not np.hypot(extent[0], extent[1]) > 0.0:
        return
    by_breadth = float(np.hypot(*(spread.high - spread.low)[:2]) / np.hypot(*extent[:2]))
    by_height = max(spread.top - view.support_z, 1e-3) / max(float(extent[2]), 1e-3 * mesh.length)
    sizes = [float(np.clip(by_height, 0.5 * by_breadth, 2.5 * by_breadth))]
    if abs(np.log(by_breadth / sizes[0])) > OTHER_SIZE:
        sizes.append(by_breadth)
    visible = turned[:, seen]
    middle = (visible.min(axis=1) + visible.max(axis=1)) / 2
    for size in sizes:
        shift = (spread.low + spread.high) / 2 - size * middle
        shift[2] = view.support_z - size * float(lowest[2])
        yield Fit(rotation, np.full(3, size), shift)


def _along(mesh: Sampled, view: PartialView) -> Iterator[Fit]:
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


def _polished(mesh: Sampled, view: PartialView, start: Fit) -> Fit:
    """The best heading within a step of a start, by a continuous search."""
    few = subsample(view.points, POINTS)
    pivot = few.mean(axis=0)

    def turned(angle: float) -> Fit:
        turn = turn_about(2, angle)
        return Fit(turn @ start.rotation, start.size, pivot + turn @ (start.shift - pivot))

    reach = HEADING_STEP if start.rotation[2, 2] > UPRIGHT else TIPPED_STEP
    found = minimize_scalar(
        lambda angle: float(chamfer_costs(mesh, view, [turned(float(angle))], few)[0]),
        bounds=(-reach, reach),
        method="bounded",
        options={"maxiter": 8},
    )
    return turned(float(found.x))


def _apart(fits: list[Fit], count: int) -> list[Fit]:
    """The first `count` of a list, without those that are turned and as large as one before."""
    chosen: list[Fit] = []
    alike = 1.0 + 2.0 * np.cos(APART_RAD)
    for fit in fits:
        if all(
            np.trace(fit.rotation.T @ other.rotation) < alike or abs(np.log(fit.size[0] / other.size[0])) > OTHER_SIZE
            for other in chosen
        ):
            chosen.append(fit)
        if len(chosen) == count:
            break
    return chosen


def _downs() -> list[tuple[Matrix3, int]]:
    """Rotations that put each of the six faces of a box down, the mesh's own first; and its axis that is upright."""
    x, y = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    flip = np.diag([1.0, -1.0, -1.0])
    return [(np.eye(3), 2), (flip, 2), (x, 0), (x.T, 0), (y, 1), (y.T, 1)]
