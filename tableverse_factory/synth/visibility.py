"""How much of each object the picture shows."""

from collections.abc import Sequence

import numpy as np
import open3d as o3d
from jaxtyping import Float64

from schemas.geometry import Camera, IdImage, Pose, TriangleMesh
from tableverse_factory.geometry.transforms import rotation_matrix

COARSER = 2
"""One ray per this many pixels each way: silhouettes need no more."""


def silhouette_areas(
    objects: Sequence[TriangleMesh], camera: Camera, camera_to_table: Pose
) -> Float64[np.ndarray, "n"]:  # noqa: F821
    """Pixels that each object would cover alone, beyond the edges of the picture too (up to its size each way)."""
    caster = o3d.t.geometry.RaycastingScene(nthreads=1)
    for mesh in objects:
        vertices = o3d.core.Tensor.from_numpy(mesh.vertices.astype(np.float32))
        caster.add_triangles(vertices, o3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)))
    v, u = np.mgrid[
        -camera.height // 2 : 3 * camera.height // 2 : COARSER, -camera.width // 2 : 3 * camera.width // 2 : COARSER
    ]
    x, y = (u.ravel() - camera.cx) / camera.fx, (v.ravel() - camera.cy) / camera.fy
    directions = np.stack([x, y, np.ones_like(x)], axis=1) @ rotation_matrix(camera_to_table.quaternion_wxyz).T
    rays = np.empty((len(directions), 6), dtype=np.float32)
    rays[:, :3], rays[:, 3:] = camera_to_table.position, directions
    hits = caster.list_intersections(o3d.core.Tensor.from_numpy(rays), nthreads=1)
    pairs = np.unique(hits["ray_ids"].numpy().astype(np.int64) * len(objects) + hits["geometry_ids"].numpy())
    return np.bincount(pairs % len(objects), minlength=len(objects)) * float(COARSER**2)


def visible_fractions(
    ids: IdImage, objects: Sequence[TriangleMesh], camera: Camera, camera_to_table: Pose
) -> tuple[np.ndarray, np.ndarray]:
    """Visible pixels of each object, and their share of its silhouette in 0–1. Both of shape (n,).

    Args:
        ids: Index of the object at each pixel; -1 or anything beyond the objects elsewhere.
        objects: In the table frame [m].
        camera: Intrinsics.
        camera_to_table: Pose of the camera.
    """
    seen = np.bincount(ids[(ids >= 0) & (ids < len(objects))], minlength=len(objects))
    alone = silhouette_areas(objects, camera, camera_to_table)
    return seen, np.clip(seen / np.maximum(alone, 1.0), 0.0, 1.0)
