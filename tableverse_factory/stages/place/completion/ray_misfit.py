"""How well a shape explains the picture: rays that should meet it at the depth seen, and rays that should miss it."""

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from jaxtyping import Bool, Float64

from schemas.geometry import Frozen, Points, Pose, TriangleMesh, Vector3
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.transforms import rotation_matrix, transform_points
from tableverse_factory.stages.place.view.object_view import ObjectView

RAYS = 1200
WORST_M = 0.012
"""What one ray costs at most [m]: the price of a ray that misses though the object was seen, or the reverse."""
PAST_MARGIN_M = 0.004
SILHOUETTE_M = 0.003
"""What a ray costs at least that meets the shape although the picture shows something else there [m]: a sheet no higher
than the depth's noise is not seen to be wrong by depth, only by its outline."""

Depths = Float64[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class RaySample(Frozen):
    """A regular sample of the window's rays, in the table frame.

    Attributes:
        eye: Their common origin [m].
        directions: Scaled so that a parameter along a ray is the depth of the point. Shape (n, 3).
        end: Depth at which the picture says the ray ends [m]; 0 where it does not say.
        facing: Cosine of incidence where the object was seen.
        own: Rays of the object's pixels.
        past: Rays that pass the object.
    """

    eye: Vector3
    directions: Points
    end: Depths
    facing: Depths
    own: Bool[np.ndarray, " n"]
    past: Bool[np.ndarray, " n"]


def sample_rays(sighting: ObjectView, count: int = RAYS) -> RaySample:
    """About `count` rays of the window, on a regular raster of pixels."""
    step = max(1, int(np.ceil(np.sqrt(sighting.own.size / count))))
    raster = (slice(step // 2, None, step), slice(step // 2, None, step))
    unit = backproject(np.ones(sighting.own.shape), sighting.camera)[raster].reshape(-1, 3)
    return RaySample(
        eye=sighting.eye,
        directions=unit @ rotation_matrix(sighting.camera_to_table.quaternion_wxyz).T,
        end=sighting.depth[raster].reshape(-1),
        facing=sighting.facing[raster].reshape(-1),
        own=sighting.own[raster].reshape(-1),
        past=sighting.past[raster].reshape(-1),
    )


def compute_misfit(rays: RaySample, hit: Depths) -> float:
    """Mean disagreement of a shape with the picture over the object's rays [m].

    Args:
        rays: What was seen.
        hit: Depth at which each ray meets the shape [m], infinite where it misses.
    """
    met = np.isfinite(hit)
    gap = np.abs(np.where(met, hit, 0.0) - rays.end) * rays.facing
    own = np.where(met, np.where(rays.end > 0.0, gap, 0.0), WORST_M)
    ahead = np.where(met & rays.past, rays.end - np.where(met, hit, 0.0), 0.0)
    least = np.where(ahead > 0.0, SILHOUETTE_M, 0.0)
    cost = np.where(rays.own, np.minimum(own, WORST_M), np.clip(ahead - PAST_MARGIN_M, least, WORST_M))
    return float(cost.sum() / max(int(rays.own.sum()), 1))


def cast_on_mesh(rays: RaySample, mesh: TriangleMesh, pose: Pose) -> Depths:
    """Depth at which each ray meets a placed mesh [m], infinite where it misses."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    vertices = transform_points(pose, mesh.vertices).astype(np.float32)
    scene.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)))
    origins = np.broadcast_to(rays.eye, rays.directions.shape)
    packed = np.concatenate([origins, rays.directions], axis=1).astype(np.float32)
    hits: Depths = scene.cast_rays(o3d.core.Tensor.from_numpy(packed), nthreads=1)["t_hit"].numpy().astype(np.float64)
    return hits


def intersect_box(rays: RaySample, pose: Pose, half_size: Vector3) -> Depths:
    """Depth at which each ray meets a box centred on its frame [m], infinite where it misses (slab method)."""
    rotation = rotation_matrix(pose.quaternion_wxyz)
    origin = (rays.eye - pose.position) @ rotation
    directions = np.ascontiguousarray((rays.directions @ rotation).T)  # a row per axis: numpy is slow on rows of three
    safe = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    one, two = (-half_size - origin)[:, None] / safe, (half_size - origin)[:, None] / safe
    enter = np.minimum(one, two).max(axis=0)
    leave = np.maximum(one, two).min(axis=0)
    return np.where((enter <= leave) & (enter > 0.0), enter, np.inf)
