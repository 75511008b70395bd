"""Fit of a box that does not stand flat: a leaning book, a cube on its edge."""

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Matrix3, Pose, Quaternion, Vector3
from tableverse_factory.geometry.math.planes import fit_min_rectangle
from tableverse_factory.geometry.math.transforms import (
    multiply_quaternions,
    normalize_quaternion,
    quaternion_from_matrix,
    rotation_matrix,
)
from tableverse_factory.stages.place.completion.box import MAX_SIDE_M, MIN_SIDE_M, SolidBox
from tableverse_factory.stages.place.completion.nelder_mead import minimize_cost
from tableverse_factory.stages.place.completion.ray_misfit import RaySample, compute_misfit, intersect_box
from tableverse_factory.stages.place.view.object_view import ObjectView

NORMALS = 400
AGREE_COS = 0.965
MIN_SECOND_SHARE = 0.08
THICKNESS_M = 0.008  # initial length of a hidden side [m]
SINK_WEIGHT = 0.2  # weight of corners below the support, against the misfit of rays
MAX_SINK_M = 0.05  # from which a corner counts no more [m]
FLOAT_WEIGHT = 0.05  # weight of the height of the lowest corner above the support, which has to be touched
STEPS = np.array([0.005] * 3 + [0.08] * 3 + [0.05] * 3)  # of the search: middle [m], logarithms of sides, turn [rad]
CALLS, NEAR_SHARE, NEAR_CALLS = 300, 0.4, 200  # of the search, and of a second one with this share of its steps
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def fit_leaning_box(view: ObjectView, rays: RaySample) -> SolidBox:
    """Fit the best box in any orientation, started along the faces that the normals show."""
    rotation = _estimate_axes(view)
    local = view.points @ rotation
    low, high = np.quantile(local, 0.005, axis=0), np.quantile(local, 0.995, axis=0)
    size = np.maximum(high - low, THICKNESS_M)
    # The seen face stays where it is when a thin start is made thicker: it grows away from the camera.
    toward = np.sign(rotation.T @ (view.eye - rotation @ ((low + high) / 2)))
    middle = (low + high) / 2 - toward * (size - (high - low)) / 2
    center = rotation @ middle
    base = quaternion_from_matrix(rotation)
    base_axes = rotation_matrix(base)
    start = np.concatenate([center, np.log(size), np.zeros(3)])

    def cost(x: Float64[np.ndarray, "9"]) -> float:
        half, axes = _decode_half_size(x), base_axes @ rotation_matrix(_decode_turn(x))
        heights = x[2] + _CORNERS @ (half * axes[2])
        sunk = np.minimum(np.maximum(view.support_z - heights, 0.0), MAX_SINK_M).mean()
        return (
            compute_misfit(rays, intersect_box(rays, x[:3], axes, half))
            + SINK_WEIGHT * float(sunk)
            + FLOAT_WEIGHT * max(float(heights.min()) - view.support_z, 0.0)
        )

    found = minimize_cost(cost, start, STEPS, CALLS)
    found = minimize_cost(cost, found, NEAR_SHARE * STEPS, NEAR_CALLS)
    turned = normalize_quaternion(multiply_quaternions(base, _decode_turn(found)))
    return SolidBox(Pose(found[:3], turned), _decode_half_size(found), cost(found))


def _decode_turn(x: Float64[np.ndarray, "9"]) -> Quaternion:
    """Decode the last three values, a small rotation vector, to a turn of the initial axes."""
    return normalize_quaternion(np.concatenate([[1.0], x[6:9] / 2]))


def _decode_half_size(x: Float64[np.ndarray, "9"]) -> Vector3:
    """Decode the logarithms of the sides, which follow the centre."""
    return np.minimum(np.maximum(np.exp(x[3:6]), MIN_SIDE_M), MAX_SIDE_M) / 2


def _estimate_axes(view: ObjectView) -> Matrix3:
    """Estimate three orthogonal axes as columns: the normal shared by most points, then the next across it."""
    step = max(1, len(view.normals) // NORMALS)
    normals = view.normals[::step]
    agreement = np.abs(normals @ normals.T) > AGREE_COS
    alike = normals[agreement[int(np.argmax(agreement.sum(axis=1)))]]
    first = np.linalg.eigh(alike.T @ alike)[1][:, 2]
    side = np.cross(first, [0.0, 0.0, 1.0] if abs(first[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(first, side)
    across = normals[np.abs(normals @ first) < 0.35]
    if len(across) >= MIN_SECOND_SHARE * len(normals):
        angles = np.arctan2(across @ up, across @ side)
        turn = float(np.angle(np.exp(4j * angles).mean()) / 4)
    else:
        turn = fit_min_rectangle(np.stack([view.points @ side, view.points @ up], axis=1)).yaw
    second = np.cos(turn) * side + np.sin(turn) * up
    return np.stack([first, second, np.cross(first, second)], axis=1)
