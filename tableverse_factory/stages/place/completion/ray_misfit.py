"""Misfit of a shape and the picture: rays that should meet it at the observed depth, rays that should miss it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.special import huber

from schemas.geometry import Frozen, Matrix3, Pose, TriangleMesh, Vector3
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.transforms import rotation_matrix, transform_points
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene, pack_rays
from tableverse_factory.stages.place.view.object_view import ObjectView

RAYS = 1200
WORST_M = 0.012  # greatest cost of one ray [m]: of one that misses though the object was seen, or the reverse
PAST_MARGIN_M = 0.004
# Least cost of a ray that meets the shape though the picture shows something else there [m]: a sheet no higher than the
# noise of the depth is wrong by its silhouette alone.
SILHOUETTE_M = 0.003
# Of estimated depth: how much errors of an object's relief count, and of its distance, and the most that one counts
# [m]. It is bent by more than the thickness of a wall, and the silhouette and the support tell the distance better.
RELIEF, DISTANCE, WORST_RELIEF_M = 0.25, 0.1, 0.008
OFTEN_OFF = 0.03  # share of the distance by which a model's is often off: where its Huber loss becomes linear
ESTIMATED_RAYS = 1600
MISS_M = 1e6  # depth at which a ray meets nothing [m]; finite, so that it can be subtracted and weighted

Depths = Float64[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class RaySample(Frozen):
    """Regular sample of the window's rays, in the table frame: first the object's, then those that pass it."""

    eye: Vector3  # common origin [m]
    directions: Float64[np.ndarray, "3 n"]  # scaled so that a parameter along a ray is the depth of the point
    end: Depths  # observed depth of the ray's end [m]; 0 where it is unknown
    facing: Float64[np.ndarray, " own"]  # cosine of incidence where the object was seen, 0 where the end is unknown
    estimated: bool = False  # whether the depth is weighed as one that a model estimated
    often_off_m: float = 0.0  # by which a model's distance is often off, below which it has a quadratic loss [m]


def sample_rays(view: ObjectView, count: int | None = None, *, estimated: bool | None = None) -> RaySample:
    """Sample about `count` rays of the window on a regular raster of pixels; those that tell nothing are left out.

    `estimated` weighs the depth as if a model had estimated it, or not, whatever it is.
    """
    estimated = view.estimated if estimated is None else estimated
    count = count or (ESTIMATED_RAYS if estimated else RAYS)
    step = max(1, int(np.ceil(np.sqrt(view.own.size / count))))
    raster = (slice(step // 2, None, step), slice(step // 2, None, step))
    own, past, end, facing = (of[raster].ravel() for of in (view.own, view.past, view.depth, view.facing))
    seen = np.flatnonzero(own)
    told = np.concatenate([seen, np.flatnonzero(past & ~own)])
    known = end[seen][end[seen] > 0.0]
    unit = backproject(np.ones(view.own.shape), view.camera)[raster].reshape(-1, 3)[told]
    return RaySample(
        eye=view.eye,
        directions=rotation_matrix(view.camera_to_table.quaternion_wxyz) @ np.ascontiguousarray(unit.T),
        end=end[told],
        facing=np.where(end[seen] > 0.0, facing[seen], 0.0),
        estimated=estimated,
        often_off_m=OFTEN_OFF * float(known.mean()) if view.estimated and len(known) else 0.0,
    )


def compute_misfit(rays: RaySample, hit: Depths) -> float:
    """Compute the mean disagreement with the picture [m] of a shape that rays meet at a depth [m], `MISS_M` for a miss.

    It is a mean over the object's rays.
    """
    count = len(rays.facing)
    ahead = rays.end - hit
    own = _weigh_estimated(rays, ahead[:count], hit[:count]) if rays.estimated else np.abs(ahead[:count])
    own *= rays.facing
    own[hit[:count] == MISS_M] = WORST_M
    beyond = ahead[count:]
    past = np.minimum(np.maximum(beyond - PAST_MARGIN_M, SILHOUETTE_M), WORST_M)
    past *= beyond > 0.0
    return float(np.minimum(own, WORST_M).sum() + past.sum()) / max(count, 1)


def _weigh_estimated(rays: RaySample, ahead: Depths, hit: Depths) -> Depths:
    """Weigh the errors of estimated depth [m]: those of the relief, about their median, and the median itself.

    A model's median has a Huber loss: a net shows bowls sunk into the table, and one that must lie so comes out flat.
    """
    met = (hit != MISS_M) & (rays.facing > 0.0)
    if not met.any():
        return np.abs(ahead)
    middle = _find_median(ahead[met])
    off = float(huber(rays.often_off_m, middle)) / rays.often_off_m if rays.often_off_m > 0.0 else abs(middle)
    return np.asarray(np.minimum(RELIEF * np.abs(ahead - middle), WORST_RELIEF_M) + DISTANCE * off)


def _find_median(values: Depths) -> float:
    """Find the median of finite values, at least one: of a few hundred `np.median` takes most of its time to check."""
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    return float(np.partition(values, (half - 1, half))[half - 1 : half + 1].mean())


def compute_mesh_misfit(rays: RaySample, mesh: TriangleMesh, pose: Pose) -> float:
    """Compute the misfit of a placed mesh [m]."""
    scene = make_raycasting_scene(TriangleMesh(transform_points(pose, mesh.vertices), mesh.faces))
    packed = pack_rays(rays.eye, rays.directions.T)
    hit = scene.cast_rays(packed, nthreads=1)["t_hit"].numpy().astype(np.float64)
    return compute_misfit(rays, np.minimum(hit, MISS_M))


def intersect_box(rays: RaySample, position: Vector3, rotation: Matrix3, half_size: Vector3) -> Depths:
    """Intersect the rays with a box centred on its frame: the depths [m], `MISS_M` for a miss."""
    enter, leave = _intersect_slabs((rays.eye - position) @ rotation, rotation.T @ rays.directions, half_size)
    return np.where((enter <= leave) & (enter > 0.0), enter, MISS_M)


def intersect_rounded_box(
    rays: RaySample, position: Vector3, rotation: Matrix3, half_size: Vector3, radius: float
) -> Depths:
    """Intersect the rays with a box whose edges along z have a radius [m]: the depths [m], `MISS_M` for a miss.

    It is the union of two boxes and four cylinders, and convex: what a ray has in common with it is one interval, from
    the first of those that it enters to the last that it leaves.
    """
    origin, directions = (rays.eye - position) @ rotation, rotation.T @ rays.directions
    x, y, z = half_size
    boxes = [_intersect_slabs(origin, directions, np.array(half)) for half in ((x - radius, y, z), (x, y - radius, z))]
    corners = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]) * (half_size[:2] - radius)
    away = origin[:2] - corners
    a = (directions[:2] ** 2).sum(axis=0)
    b = away @ directions[:2]
    c = (away**2).sum(axis=1)[:, None] - radius * radius
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray that passes a cylinder, or runs along its axis
        root = np.sqrt(b * b - a * c)
        enter, leave = (-b - root) / a, (-b + root) / a
        low, high = (-z - origin[2]) / directions[2], (z - origin[2]) / directions[2]
    enter, leave = np.maximum(enter, np.minimum(low, high)), np.minimum(leave, np.maximum(low, high))
    enter = np.concatenate([[into for into, _ in boxes], enter])
    leave = np.concatenate([[out for _, out in boxes], leave])
    met = enter <= leave
    first = np.where(met, enter, np.inf).min(axis=0)
    return np.where(met.any(axis=0) & (first > 0.0), first, MISS_M)


def _intersect_slabs(
    origin: Vector3, directions: Float64[np.ndarray, "3 n"], half_size: Vector3
) -> tuple[Depths, Depths]:
    """Intersect rays with the box about the origin: the depths where they enter and leave it, if the first is less."""
    with np.errstate(divide="ignore", invalid="ignore"):  # rays along a face: the quotients are infinite
        one, two = (-half_size - origin)[:, None] / directions, (half_size - origin)[:, None] / directions
        return np.minimum(one, two).max(axis=0), np.maximum(one, two).min(axis=0)
