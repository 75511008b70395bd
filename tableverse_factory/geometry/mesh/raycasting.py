"""Rays against meshes and nearest points on them: Embree through Open3D, in single precision, on one thread."""

import numpy as np

from schemas.geometry import Camera, Pose, TriangleMesh
from tableverse_factory.core.open3d_import import o3d
from tableverse_factory.geometry.math.camera import compute_pixel_rays

RaycastingScene = o3d.t.geometry.RaycastingScene


def make_raycasting_scene(*meshes: TriangleMesh) -> RaycastingScene:
    """Scene of meshes of one frame; `geometry_ids` number them in their order."""
    scene = RaycastingScene(nthreads=1)
    for mesh in meshes:
        faces = o3d.core.Tensor.from_numpy(np.ascontiguousarray(mesh.faces, dtype=np.uint32))
        scene.add_triangles(to_tensor(mesh.vertices), faces)
    return scene


def to_tensor(values: np.ndarray) -> o3d.core.Tensor:
    """The values in single precision, for queries."""
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def pack_rays(origins: np.ndarray, directions: np.ndarray) -> o3d.core.Tensor:
    """Rays for a query, shape (..., 6); origins and directions are broadcast against each other."""
    shape = np.broadcast_shapes(origins.shape, directions.shape)
    rays = np.empty((*shape[:-1], 6), dtype=np.float32)
    rays[..., :3], rays[..., 3:] = origins, directions
    return o3d.core.Tensor.from_numpy(rays)


def pack_pixel_rays(camera: Camera, camera_to_scene: Pose) -> o3d.core.Tensor:
    """Rays of all pixels, shape (h, w, 6); where one meets a surface, `t_hit` is the depth along the optical axis."""
    return pack_rays(camera_to_scene.position, compute_pixel_rays(camera, camera_to_scene))
