"""Registration of a mesh without pose or size to observed points (paper section 3.1).

Coarse: for each face that can be down, a search over the heading that minimises the Chamfer distance, on two fixed
k-d trees (the query turns, nothing is rebuilt). Fine: point-to-plane ICP over rotation, translation and the size along
each axis, far points weighted down. The way from the observed points to the mesh counts most: a single view shows a
part, and the part that it hides must not pull.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from schemas.geometry import Frozen, Matrix3, Points, Pose, TriangleMesh, Vector3
from tableverse_factory.errors import GeometryError
from tableverse_factory.geometry.meshes import box_center
from tableverse_factory.geometry.samples import distance_to_surface, surface_samples
from tableverse_factory.geometry.transforms import quaternion_from_matrix

SAMPLES = 3000
COARSE_POINTS = 300
FINE_POINTS = 2000
RESIDUAL_POINTS = 1000
HEADINGS = 72
TIPPED_HEADINGS = 24
HIDDEN_WEIGHT = 0.15
"""Weight of the way from the visible side of the mesh to the points, against 1 for the way back."""
TIPPED_PRICE_M = 0.002
"""A mesh that lies on another than its own lower face has to fit this much better."""
REFINED = 4
STEPS = 40
ROBUST_M = 0.004
SIZE_PRIOR = 0.02
"""Weight of keeping the mesh's own proportions, against one observed point: it decides only about hidden sizes."""
SIZE_RANGE = (0.7, 1.4)
"""Bounds of the size along each axis, against the size that the height suggests."""


@dataclass(frozen=True, slots=True, eq=False)
class Registration(Frozen):
    """Where a mesh stands, and how large.

    Attributes:
        pose: The mesh's own frame in the table frame, after `size`.
        size: Factor along each of the mesh's own axes. Shape (3,).
        residual_m: Median distance from the observed points to the placed mesh.
    """

    pose: Pose
    size: Vector3
    residual_m: float


@dataclass(frozen=True, slots=True, eq=False)
class _Fit(Frozen):
    """`table = rotation @ (size * mesh) + shift`, and its price [m]."""

    rotation: Matrix3
    size: Vector3
    shift: Vector3
    price: float


def register(mesh: TriangleMesh, points: Points, eye: Vector3, support_z: float) -> Registration:
    """Heading, position and size of a mesh from the points of one view.

    Args:
        mesh: In its own frame, z up as it usually stands; any unit.
        points: Observed points, table frame [m]. Shape (n, 3).
        eye: Position of the camera, table frame [m].
        support_z: Height of what the object stands on [m].

    Raises:
        GeometryError: if there are too few points or the mesh has no extent.
    """
    if len(points) < 10:
        raise GeometryError(f"{len(points)} points are too few to register a mesh; at least 10 are needed")
    middle = box_center(mesh)
    samples, normals = _samples_with_normals(mesh)
    samples = samples - middle
    if not np.ptp(samples, axis=0).max() > 0.0:
        raise GeometryError("the mesh has no extent")
    starts = _coarse(samples, normals, points, eye, support_z)
    tree = cKDTree(samples)
    best = min((_refine(samples, normals, tree, points, start) for start in starts), key=lambda fit: fit.price)
    shift = best.shift - best.rotation @ (best.size * middle)
    placed = TriangleMesh((mesh.vertices * best.size) @ best.rotation.T + shift, mesh.faces)
    return Registration(Pose(shift, quaternion_from_matrix(best.rotation)), best.size, median_distance(points, placed))


def median_distance(points: Points, mesh: TriangleMesh) -> float:
    """Median distance from the points to the surface [m]."""
    thinned = points[:: max(1, len(points) // RESIDUAL_POINTS)]
    return float(np.median(distance_to_surface(thinned, mesh, SAMPLES)))


def _samples_with_normals(mesh: TriangleMesh) -> tuple[Points, Points]:
    """Points on the surface and the unit normals of their triangles."""
    samples, triangle = surface_samples(mesh, SAMPLES)
    a, b, c = (mesh.vertices[mesh.faces[triangle, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    normals: Points = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-300)
    return samples, normals


def _coarse(samples: Points, normals: Points, points: Points, eye: Vector3, support_z: float) -> list[_Fit]:
    """The best few starts over the faces that can be down and the headings, no two of them alike."""
    few = points[:: max(1, len(points) // COARSE_POINTS)]
    thin = slice(None, None, max(1, len(samples) // COARSE_POINTS))
    mesh_tree, point_tree = cKDTree(samples), cKDTree(points)
    fits: list[_Fit] = []
    for index, down in enumerate(_downs()):
        count = TIPPED_HEADINGS if index else HEADINGS
        for heading in 2 * np.pi * np.arange(count) / count:
            rotation = _about_z(heading) @ down
            start = _aligned(samples, normals, points, rotation, eye, support_z)
            if start is None:
                continue
            size, shift, seen = start
            there = mesh_tree.query((few - shift) @ rotation / size)[0] * size
            back = point_tree.query((samples[thin] * size) @ rotation.T + shift)[0][seen[thin]]
            price = float(there.mean()) + HIDDEN_WEIGHT * float(back.mean() if len(back) else 0.0)
            fits.append(_Fit(rotation, np.full(3, size), shift, price + (TIPPED_PRICE_M if index else 0.0)))
    chosen: list[_Fit] = []
    for fit in sorted(fits, key=lambda fit: fit.price):
        if all(np.trace(fit.rotation.T @ other.rotation) < 1.0 + 2.0 * np.cos(0.3) for other in chosen):
            chosen.append(fit)
        if len(chosen) == REFINED:
            break
    if not chosen:
        raise GeometryError("no heading of the mesh faces the camera")
    return chosen


def _aligned(
    samples: Points, normals: Points, points: Points, rotation: Matrix3, eye: Vector3, support_z: float
) -> tuple[float, Vector3, Float64[np.ndarray, " n"]] | None:
    """Size from the height, position from the box of the side that faces the camera."""
    turned = samples @ rotation.T
    to_eye = eye - points.mean(axis=0)
    seen = (normals @ rotation.T) @ to_eye > 0.0
    height = float(np.ptp(turned[:, 2]))
    if seen.sum() < 10 or height <= 0.0:
        return None
    top = float(np.quantile(points[:, 2], 0.995))
    size = max(top - support_z, 1e-3) / height
    ours = turned[seen] * size
    low, high = np.quantile(points, 0.01, axis=0), np.quantile(points, 0.99, axis=0)
    shift = (low + high) / 2 - (ours.min(axis=0) + ours.max(axis=0)) / 2
    shift[2] = support_z - size * float(turned[:, 2].min())
    return size, shift, seen


def _refine(samples: Points, normals: Points, tree: cKDTree, points: Points, start: _Fit) -> _Fit:
    """Point-to-plane ICP over a small turn, a shift and three sizes, with Cauchy weights."""
    target = points[:: max(1, len(points) // FINE_POINTS)]
    rotation, size, shift = start.rotation, start.size.copy(), start.shift.copy()
    base = start.size.copy()
    scale = float(np.ptp(samples, axis=0).max())
    for step in range(STEPS):
        local = (target - shift) @ rotation
        _, index = tree.query(local / size)
        q, n = samples[index], normals[index] / size
        n = n / np.linalg.norm(n, axis=1, keepdims=True)
        gap = ((local - size * q) * n).sum(axis=1)
        width = max(ROBUST_M, 0.03 * (1.0 - step / STEPS) * scale * float(size.mean()))
        weight = 1.0 / (1.0 + (gap / width) ** 2)
        # d gap = -n . (turn x local) - n . move - n . (q * d size), all in the mesh's own directions
        rows = np.concatenate([np.cross(local, n), n, n * q * size], axis=1)
        prior = np.diag([1e-6] * 3 + [1e-6] * 3 + [SIZE_PRIOR * len(target) * (0.1 * scale * size.mean()) ** 2] * 3)
        pull = np.concatenate([np.zeros(6), prior[6:, 6:] @ np.log(base / size)])
        solution = np.linalg.solve((rows * weight[:, None]).T @ rows + prior, (rows * weight[:, None]).T @ gap + pull)
        turn = _turn(np.clip(solution[:3], -0.2, 0.2))
        shift = shift + rotation @ solution[3:6]
        rotation = rotation @ turn
        size = np.clip(size * np.exp(np.clip(solution[6:], -0.1, 0.1)), SIZE_RANGE[0] * base, SIZE_RANGE[1] * base)
        if float(np.abs(solution).max()) < 1e-5:
            break
    distance = tree.query((target - shift) @ rotation / size)[0] * float(size.mean())
    price = float(np.minimum(distance, 5 * ROBUST_M).mean())
    return _Fit(rotation, size, shift, price + (0.0 if start.rotation[2, 2] > 0.9 else TIPPED_PRICE_M / 2))


def _downs() -> list[Matrix3]:
    """Rotations that put each of the six faces of a box down, the mesh's own first."""
    flips = [np.eye(3), np.diag([1.0, -1.0, -1.0])]
    x, y = np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return [*flips, x, x.T, y, y.T]


def _about_z(angle: float) -> Matrix3:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _turn(vector: Vector3) -> Matrix3:
    """The rotation about a vector by its length (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn: Matrix3 = np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)
    return turn
