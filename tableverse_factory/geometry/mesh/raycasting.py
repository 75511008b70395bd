"""Rays against meshes and nearest points on them: Embree through Open3D, in single precision, on one thread."""

import numpy as np

from schemas.geometry import TriangleMesh
from tableverse_factory.core.open3d_import import o3d

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
