"""Misfit of a shape and the picture: rays that should meet it at the observed depth, rays that should miss it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from schemas.geometry import Frozen, Points, Pose, TriangleMesh, Vector3
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

Depths = Float64[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class RaySample(Frozen):
    """Regular sample of the window's rays, in the table frame."""

    eye: Vector3  # common origin [m]
    directions: Points  # scaled so that a parameter along a ray is the depth of the point
    end: Depths  # observed depth of the ray's end [m]; 0 where it is unknown
    facing: Depths  # cosine of incidence where the object was seen
    own: Bool[np.ndarray, " n"]  # rays of the object's pixels
    past: Bool[np.ndarray, " n"]  # rays that pass the object


def sample_rays(view: ObjectView, count: int = RAYS) -> RaySample:
    """Sample about `count` rays of the window on a regular raster of pixels."""
    step = max(1, int(np.ceil(np.sqrt(view.own.size / count))))
    raster = (slice(step // 2, None, step), slice(step // 2, None, step))
    unit = backproject(np.ones(view.own.shape), view.camera)[raster].reshape(-1, 3)
    return RaySample(
        eye=view.eye,
        directions=unit @ rotation_matrix(view.camera_to_table.quaternion_wxyz).T,
        end=view.depth[raster].reshape(-1),
        facing=view.facing[raster].reshape(-1),
        own=view.own[raster].reshape(-1),
        past=view.past[raster].reshape(-1),
    )


def compute_misfit(rays: RaySample, hit: Depths) -> float:
    """Compute the mean disagreement with the picture [m] of a shape that rays meet at a depth [m], infinite for a miss.

    It is a mean over the object's rays.
    """
    met = np.isfinite(hit)
    gap = np.abs(np.where(met, hit, 0.0) - rays.end) * rays.facing
    own = np.where(met, np.where(rays.end > 0.0, gap, 0.0), WORST_M)
    ahead = np.where(met & rays.past, rays.end - np.where(met, hit, 0.0), 0.0)
    least = np.where(ahead > 0.0, SILHOUETTE_M, 0.0)
    cost = np.where(rays.own, np.minimum(own, WORST_M), np.clip(ahead - PAST_MARGIN_M, least, WORST_M))
    return float(cost.sum() / max(int(rays.own.sum()), 1))


def compute_mesh_misfit(rays: RaySample, mesh: TriangleMesh, pose: Pose) -> float:
    """Compute the misfit of a placed mesh [m]."""
    scene = make_raycasting_scene(TriangleMesh(transform_points(pose, mesh.vertices), mesh.faces))
    packed = pack_rays(rays.eye, rays.directions)
    return compute_misfit(rays, scene.cast_rays(packed, nthreads=1)["t_hit"].numpy().astype(np.float64))


def intersect_box(rays: RaySample, pose: Pose, half_size: Vector3) -> Depths:
    """Intersect the rays with a box centred on its frame (slab method): the depths [m], infinite for a miss."""
    rotation = rotation_matrix(pose.quaternion_wxyz)
    origin = (rays.eye - pose.position) @ rotation
    directions = np.ascontiguousarray((rays.directions @ rotation).T)  # a row per axis: numpy is slow on rows of three
    safe = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    one, two = (-half_size - origin)[:, None] / safe, (half_size - origin)[:, None] / safe
    enter = np.minimum(one, two).max(axis=0)
    leave = np.maximum(one, two).min(axis=0)
    return np.where((enter <= leave) & (enter > 0.0), enter, np.inf)
