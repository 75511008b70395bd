"""Point-to-plane ICP with a size along each axis, and the uncertainty of its result.

Minimises the squared distances of the points to the mesh, robustly weighted, over their measured noise, plus a prior:
a mesh roughly keeps its proportions and stands on its support. Parts that the view leaves open, such as the far side
of a box, are then as uncertain as those proportions.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from schemas.geometry import Frozen, Matrix3, Points, TriangleMesh, Vector3
from tableverse_factory.geometry.math.transforms import quaternion_from_rotation_vector, rotation_matrix
from tableverse_factory.geometry.mesh.surface_samples import sample_surface

SAMPLES = 3000
ROBUST_M = 0.004
NOISE_M = 0.0004  # lower bound of the points' noise
OUTLINE_M = 0.002  # accuracy of the free space: a pixel or two, and the error of its depth
OUTLINE_POINTS = 300
IN_COMMON = 2.0  # the scatter within one picture shows about half of the error, measured on synthetic truth
SYSTEMATIC_M, SYSTEMATIC_RAD = 0.0015, 0.0035  # lower bounds: outlines a pixel too narrow, depth quantisation; measured
OUTLINES = 30  # effective number of outline points: their errors are correlated
INDEPENDENT = 300  # effective number of observed points, at most: errors of neighbours are correlated
SCALE_STD = 1.0  # of the logarithm of the overall size: nearly unconstrained
SIZE_RANGE = (0.6, 1.6)  # bounds of the size along each axis, against its start
CELLS = 4  # cells along the object's longest side; points within one have errors in common

Gaps = Float64[np.ndarray, " n"]
Emptiness = Callable[[Points], Gaps]  # signed distance to the space seen to be empty [m], negative inside it
Rows = Float64[np.ndarray, "n 9"]
Matrix9 = Float64[np.ndarray, "9 9"]


@dataclass(frozen=True, slots=True, eq=False)
class SampledMesh(Frozen):
    """A surface as points about the middle of its box, with unit normals (n, 3); `length` is the box's longest side."""

    points: Points
    normals: Points
    tree: cKDTree
    length: float


@dataclass(frozen=True, slots=True, eq=False)
class Fit(Frozen):
    """`table = rotation @ (size * mesh) + shift`, the mesh about the middle of its box [m]."""

    rotation: Matrix3
    size: Vector3
    shift: Vector3


@dataclass(frozen=True, slots=True, eq=False)
class PartialView(Frozen):
    """Points (n, 3) of an object seen from one camera position, table frame [m].

    The height of the support is ignored where the object clearly does not stand there; its standard deviation is large
    in a container, whose floor is hidden. `emptiness` is the free space of the same view: the points alone do not show
    where a face ends.
    """

    points: Points
    eye: Vector3
    support_z: float
    support_std_m: float
    emptiness: Emptiness


@dataclass(frozen=True, slots=True, eq=False)
class _LinearSystem(Frozen):
    """Equations of a fit in the mesh frame: rotation, translation, log sizes; a row per point, then the foot's."""

    rows: Rows
    gaps: Gaps
    weights: Gaps
    points: Points
    prior: Matrix9
    pull: Float64[np.ndarray, "9"]


def sample_mesh(mesh: TriangleMesh, middle: Vector3) -> SampledMesh:
    """Sample a mesh about `middle`, with normals."""
    samples, triangle = sample_surface(mesh, SAMPLES)
    a, b, c = (mesh.vertices[mesh.faces[triangle, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    normals: Points = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)
    samples = samples - middle
    return SampledMesh(samples, normals, cKDTree(samples), float(np.ptp(samples, axis=0).max()))


def subsample(points: Points, count: int) -> Points:
    """Select about `count` points, evenly over their order."""
    return points[:: max(1, len(points) // count)]


def run_icp(
    mesh: SampledMesh, view: PartialView, start: Fit, steps: int, settled: float, proportions_std: float
) -> Fit:
    """Find the fit near `start`, to about 30° and a third of its size, that agrees best with the view.

    A step smaller than `settled` [m, rad] is the last. `proportions_std` is the prior standard deviation of the
    logarithm of the size along an axis against the others.
    """
    fit = start
    for k in range(steps):
        width = max(ROBUST_M, 0.03 * (1.0 - k / steps) * mesh.length * float(fit.size.mean()))
        step = _linearize(mesh, view, fit, start.size, width, proportions_std)
        weighted = step.rows * step.weights[:, None]
        change = np.linalg.solve(weighted.T @ step.rows + step.prior, weighted.T @ step.gaps + step.pull)
        size = fit.size * np.exp(np.clip(change[6:], -0.1, 0.1))
        fit = Fit(
            fit.rotation @ rotation_matrix(quaternion_from_rotation_vector(np.clip(change[:3], -0.2, 0.2))),
            np.clip(size, SIZE_RANGE[0] * start.size, SIZE_RANGE[1] * start.size),
            fit.shift + fit.rotation @ change[3:6],
        )
        if float(np.abs(change).max()) < settled:
            break
    return fit


def estimate_pose_std(mesh: SampledMesh, view: PartialView, fit: Fit, proportions_std: float) -> tuple[float, float]:
    """Estimate the standard deviations of the centre [m] and of the heading [rad] at a fit.

    Sandwich estimator: the inverse information matrix around the scatter of clusters of points, as neighbours err
    together. It reflects both the points' noise and a slightly wrong mesh; a calibrated share that no single picture
    shows is added (`tableverse bench placement`).
    """
    step = _linearize(mesh, view, fit, fit.size, ROBUST_M, proportions_std)
    weighted = step.rows * step.weights[:, None]
    inverse = np.linalg.inv(weighted.T @ step.rows + step.prior)
    said = weighted * step.gaps[:, None]
    cells = _number_cells(step.points)
    cells = np.append(cells, cells.max() + 1)
    parts = np.stack([np.bincount(cells, weights=said[:, k]) for k in range(9)], axis=1)
    scatter = parts.T @ parts * (len(parts) / max(len(parts) - 1, 1))
    covariance = inverse @ (scatter + step.prior) @ inverse
    up = fit.rotation[2]
    position = float(np.sqrt(max(np.trace(covariance[3:6, 3:6]), 0.0)))
    heading = float(np.sqrt(max(up @ covariance[:3, :3] @ up, 0.0)))
    return float(np.hypot(IN_COMMON * position, SYSTEMATIC_M)), float(np.hypot(IN_COMMON * heading, SYSTEMATIC_RAD))


def _linearize(
    mesh: SampledMesh, view: PartialView, fit: Fit, kept: Vector3, width: float, proportions_std: float
) -> _LinearSystem:
    local = (view.points - fit.shift) @ fit.rotation
    _, index = mesh.tree.query(local / fit.size)
    q = mesh.points[index] * fit.size
    n = mesh.normals[index] / fit.size
    n = n / np.linalg.norm(n, axis=1, keepdims=True)
    gaps = ((local - q) * n).sum(axis=1)
    noise = max(NOISE_M, 1.4826 * float(np.median(np.abs(gaps))))
    weights = min(1.0, INDEPENDENT / len(gaps)) / (noise**2 * (1.0 + (gaps / width) ** 2))
    foot, off = _linearize_foot(mesh, fit, view.support_z)
    standing = 1.0 / (view.support_std_m**2 * (1.0 + (off / width) ** 2))
    out_rows, out_gaps, out_points = _linearize_protrusions(mesh, view, fit)
    out_weights = 1.0 / (OUTLINE_M**2 * (1.0 + (out_gaps / (3 * width)) ** 2)) * OUTLINES / OUTLINE_POINTS
    prior, pull = _make_prior(fit, kept, proportions_std)
    return _LinearSystem(
        # Derivatives of the gap along the normal by rotation, translation and sizes.
        np.concatenate([np.concatenate([np.cross(local, n), n, n * q], axis=1), out_rows, foot[None]]),
        np.concatenate([gaps, out_gaps, [off]]),
        np.concatenate([weights, out_weights, [standing]]),
        np.concatenate([view.points, out_points]),
        prior,
        pull,
    )


def _linearize_protrusions(mesh: SampledMesh, view: PartialView, fit: Fit) -> tuple[Rows, Gaps, Points]:
    """Linearise the depth of mesh points that lie in free space."""
    q = subsample(mesh.points, OUTLINE_POINTS) * fit.size
    points = q @ fit.rotation.T + fit.shift
    depth = view.emptiness(points) + OUTLINE_M
    out = depth < 0.0
    q, points, depth = q[out], points[out], depth[out]
    beside = (points + OUTLINE_M * np.eye(3)[:, None]).reshape(-1, 3)
    slopes = (view.emptiness(beside).reshape(3, -1).T + OUTLINE_M - depth[:, None]) / OUTLINE_M
    slopes /= np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1.0)
    away = slopes @ fit.rotation
    return np.concatenate([np.cross(q, away), away, away * q], axis=1), -depth, points


def _linearize_foot(mesh: SampledMesh, fit: Fit, support_z: float) -> tuple[Float64[np.ndarray, "9"], float]:
    """Linearise the height of the lowest point, and measure how far it has to rise to stand [m]."""
    up = fit.rotation[2]
    heights = mesh.points @ (fit.size * up)
    q = mesh.points[int(np.argmin(heights))] * fit.size
    row = np.concatenate([np.cross(q, up), up, up * q])
    return row, support_z - float(heights.min() + fit.shift[2])


def _make_prior(fit: Fit, kept: Vector3, proportions_std: float) -> tuple[Matrix9, Float64[np.ndarray, "9"]]:
    """Make the prior of the sizes: alike along all axes against `kept`."""
    mean = np.full((3, 3), 1.0 / 3.0)
    sizes = (np.eye(3) - mean) / proportions_std**2 + mean / SCALE_STD**2
    prior = np.zeros((9, 9))
    prior[:6, :6] = np.diag([1.0] * 3 + [1e2] * 3)  # a round object has no heading: a weak prior keeps it in place
    prior[6:, 6:] = sizes
    return prior, np.concatenate([np.zeros(6), sizes @ np.log(kept / fit.size)])


def _number_cells(points: Points) -> Int64[np.ndarray, " n"]:
    low = points.min(axis=0)
    cell = max(float(np.ptp(points, axis=0).max()) / CELLS, 1e-9)
    _, which = np.unique(np.floor((points - low) / cell).astype(np.int64), axis=0, return_inverse=True)
    return which.ravel()
