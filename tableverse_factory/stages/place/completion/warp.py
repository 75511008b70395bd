"""Smooth warp of a hollow surface of revolution to the points seen: no plate or cup is exactly round, upright and even.

A wall of a millimetre overlaps with the true one only where it is known to less than that. All points together tell a
small affine map and a bend of the heights much more precisely than one of them tells its place.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64
from manifold3d import Manifold

from schemas.geometry import Points, TriangleMesh, Vector3
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene, to_tensor
from tableverse_factory.geometry.mesh.voxel_solids import from_manifold
from tableverse_factory.stages.place.view.object_view import ObjectView

FIT_POINTS = 3000
STEPS = 3
SCALE_M = 0.0015  # distance from the surface at which a point counts by half [m]
STIFFNESS = 0.002  # weight of no warp at all against the evidence of all points
REACH_M = 0.005  # most distance of a point that belongs to the surface [m]
AGREEING_COS = 0.6  # least cosine between a point's normal and the surface's: the other side of a wall is near as well

Warp = Callable[[Points], Points]
Numbers = Float64[np.ndarray, "15"]  # four of each coordinate, then three of the bend of the heights [m]


def fit_warp(view: ObjectView, body: Manifold, middle: Vector3) -> Warp:
    """Fit the warp about a point that moves a body, all in the table frame, to the object's points."""
    step = max(1, len(view.points) // FIT_POINTS)
    points, normals = view.points[::step], view.normals[::step]
    mesh = from_manifold(body)
    size = float(np.abs(mesh.vertices - middle).max())
    numbers: Numbers = np.zeros(15)

    def warp(places: Points) -> Points:
        linear, bend = _compute_basis((places - middle) / size)
        moved: Points = places + linear @ numbers[:12].reshape(3, 4).T
        moved[:, 2] += bend @ numbers[12:]
        return moved

    for _ in range(STEPS):
        scene = make_raycasting_scene(TriangleMesh(warp(mesh.vertices), mesh.faces))
        nearest = scene.compute_closest_points(to_tensor(points), nthreads=1)
        at, facing = (nearest[key].numpy().astype(np.float64) for key in ("points", "primitive_normals"))
        gap = ((points - at) * facing).sum(axis=1)
        beside = np.abs(points - at - gap[:, None] * facing).max(axis=1)  # beyond an edge of the body
        own = (beside < 1e-3) & ((facing * normals).sum(axis=1) > AGREEING_COS) & (np.abs(gap) < REACH_M)
        linear, bend = _compute_basis((at[own] - middle) / size)
        rows = np.concatenate([*(linear * facing[own, k, None] for k in range(3)), bend * facing[own, 2, None]], axis=1)
        weighted = rows / (1.0 + (gap[own, None] / SCALE_M) ** 2)
        ridge = STIFFNESS * max(int(own.sum()), 1) * np.eye(len(numbers))
        numbers = np.linalg.solve(weighted.T @ rows + ridge, weighted.T @ (gap[own] + rows @ numbers))
    return warp


def _compute_basis(places: Points) -> tuple[Float64[np.ndarray, "n 4"], Float64[np.ndarray, "n 3"]]:
    """Compute the functions of an affine map, and of a bend, at places in units of the body's size."""
    x, y = places[:, 0], places[:, 1]
    return np.column_stack([np.ones(len(places)), places]), np.column_stack([x * x, x * y, y * y])
