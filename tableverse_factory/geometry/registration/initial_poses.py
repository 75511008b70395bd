"""Initial poses of a registration: a few rough, distinct placements of a mesh (paper section 3.1).

For each face that can be down, headings on a grid, then a continuous search about the best of them; and alignments of
the longest axes of mesh and points. Of symmetric headings, only those nearest to the mesh's own are tried.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize_scalar

from schemas.geometry import Matrix3, Points, Vector3
from tableverse_factory.geometry.registration.fit_cost import UPRIGHT, compute_chamfer_costs
from tableverse_factory.geometry.registration.icp import Fit, PartialView, SampledMesh, subsample
from tableverse_factory.geometry.registration.symmetry import rotation_about_axis

POINTS = 150
HEADING_STEP = float(np.deg2rad(5.0))
TIPPED_STEP = float(np.deg2rad(15.0))
MAX_STARTS, MAX_UPRIGHT_STARTS = 7, 3  # in all, and of them those on the mesh's own lower face at first
APART_RAD, OTHER_SIZE = 0.3, 0.1

# Rotations that put each of the six faces of a box down, the mesh's own first, and the axis then upright.
_X_DOWN, _Y_DOWN = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
_OWN_DOWN, _TOP_DOWN = np.eye(3), np.diag([1.0, -1.0, -1.0])
_DOWN_ROTATIONS = ((_OWN_DOWN, 2), (_TOP_DOWN, 2), (_X_DOWN, 0), (_X_DOWN.T, 0), (_Y_DOWN, 1), (_Y_DOWN.T, 1))
_Spread = tuple[Vector3, Vector3, Vector3, float]  # 1 % and 99 % quantiles of the observed points, mean and top [m]


def find_initial_poses(mesh: SampledMesh, view: PartialView, folds: Sequence[int]) -> list[Fit]:
    """Find the best few starts, no two alike; `folds` about each of the mesh's own axes are 0 for a round one."""
    guesses = list(_generate_guesses(mesh, view, folds))
    price = compute_chamfer_costs(mesh, view, guesses, subsample(view.points, POINTS))
    ordered = [guesses[k] for k in np.argsort(price, kind="stable")]
    usual = [fit for fit in ordered if fit.rotation[2, 2] > UPRIGHT]
    return [
        _refine_heading(mesh, view, fit)
        for fit in _drop_similar([*_drop_similar(usual, MAX_UPRIGHT_STARTS), *ordered], MAX_STARTS)
    ]


def _generate_guesses(mesh: SampledMesh, view: PartialView, folds: Sequence[int]) -> Iterator[Fit]:
    low, high = np.quantile(view.points, (0.01, 0.99), axis=0)
    spread = low, high, view.points.mean(axis=0), float(np.quantile(view.points[:, 2], 0.995))
    for index, (down, axis) in enumerate(_DOWN_ROTATIONS):
        step = TIPPED_STEP if index else HEADING_STEP
        for heading in _list_headings(folds[axis], step):
            yield from _place_standing(mesh, view, spread, rotation_about_axis(2, heading) @ down)
    yield from _align_longest_axes(mesh, view)


def _list_headings(folds: int, step: float) -> Float64[np.ndarray, " n"]:
    """List the headings of one of `folds` equal parts of the circle, about the mesh's own."""
    if folds == 0:
        return np.zeros(1)
    count = max(1, round(2 * np.pi / folds / step))
    part: Float64[np.ndarray, " n"] = 2 * np.pi / folds * (np.arange(count) / count)
    return np.sort(np.where(part > np.pi / folds, part - 2 * np.pi / folds, part))


def _place_standing(mesh: SampledMesh, view: PartialView, spread: _Spread, rotation: Matrix3) -> Iterator[Fit]:
    """Take the size from the height and, where it differs, from the breadth; the position from what faces the camera.

    A sheet has hardly any height, and a partly hidden object is too narrow.
    """
    low, high, mean, top = spread
    turned = rotation @ mesh.points.T
    seen = mesh.normals @ (rotation.T @ (view.eye - mean)) > 0.0
    lowest = turned.min(axis=1)
    extent = turned.max(axis=1) - lowest
    if seen.sum() < 10 or not np.hypot(extent[0], extent[1]) > 0.0:
        return
    by_breadth = float(np.hypot(*(high - low)[:2]) / np.hypot(*extent[:2]))
    by_height = max(top - view.support_z, 1e-3) / max(float(extent[2]), 1e-3 * mesh.length)
    sizes = [float(np.clip(by_height, 0.5 * by_breadth, 2.5 * by_breadth))]
    if abs(np.log(by_breadth / sizes[0])) > OTHER_SIZE:
        sizes.append(by_breadth)
    visible = turned[:, seen]
    middle = (visible.min(axis=1) + visible.max(axis=1)) / 2
    for size in sizes:
        shift = (low + high) / 2 - size * middle
        shift[2] = view.support_z - size * float(lowest[2])
        yield Fit(rotation, np.full(3, size), shift)


def _align_longest_axes(mesh: SampledMesh, view: PartialView) -> Iterator[Fit]:
    """Align the principal axes of mesh and points, as long as the points or down to the support."""
    ours, theirs = _compute_principal_axes(mesh.points), _compute_principal_axes(view.points)
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


def _compute_principal_axes(points: Points) -> Matrix3:
    """Compute right-handed principal axes in columns, the longest first."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1][:, ::-1].copy()
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return axes


def _refine_heading(mesh: SampledMesh, view: PartialView, start: Fit) -> Fit:
    few = subsample(view.points, POINTS)
    pivot = few.mean(axis=0)

    def turned(angle: float) -> Fit:
        turn = rotation_about_axis(2, angle)
        return Fit(turn @ start.rotation, start.size, pivot + turn @ (start.shift - pivot))

    reach = HEADING_STEP if start.rotation[2, 2] > UPRIGHT else TIPPED_STEP
    found = minimize_scalar(
        lambda angle: float(compute_chamfer_costs(mesh, view, [turned(float(angle))], few)[0]),
        bounds=(-reach, reach),
        method="bounded",
        options={"maxiter": 8},
    )
    return turned(float(found.x))


def _drop_similar(fits: list[Fit], count: int) -> list[Fit]:
    """Select the first `count` fits, without those of about the same rotation and size as one before."""
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
