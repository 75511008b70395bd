"""Camera and shadow rays against meshes, on the CPU."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.geometry import Camera, Frozen, Points, Pose, TriangleMesh
from tableverse_factory.geometry.math.camera import compute_pixel_rays
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene, pack_pixel_rays, pack_rays

SURFACE_OFFSET_M = 1e-4  # start of rays that leave a surface: less than any wall, more than float32's error at a metre


@dataclass(frozen=True, slots=True, eq=False)
class Hits(Frozen):
    """Hits of a camera's rays, in the order of pixels of the flattened picture: the mesh (`part`), face and point hit.

    Attributes:
        depth: Distance along the optical axis [m]. Shape (n,), float32.
        weights: Barycentric weights of the face's corners. Shape (n, 3), float32.
        points: World positions [m]. Shape (n, 3).
        normals: Unit normals of the faces, towards the eye. Shape (n, 3), float32.
    """

    pixels: np.ndarray
    depth: np.ndarray
    part: np.ndarray
    triangles: np.ndarray
    weights: np.ndarray
    points: Points
    normals: np.ndarray


class Raycaster:
    """Meshes in the world frame; one without faces is allowed and never hit."""

    def __init__(self, parts: Sequence[TriangleMesh]) -> None:
        filled = [index for index, mesh in enumerate(parts) if len(mesh.faces)]
        self._caster = make_raycasting_scene(*(parts[index] for index in filled))
        self._part_of = np.array(filled, dtype=np.int32)

    def cast(self, camera: Camera, camera_to_world: Pose, offset: tuple[float, float] = (0.0, 0.0)) -> Hits:
        """Cast one ray per pixel, `offset` from its centre [px]."""
        directions = compute_pixel_rays(camera, camera_to_world, offset).reshape(-1, 3)
        answer = self._caster.cast_rays(pack_rays(camera_to_world.position, directions), nthreads=1)
        depth = answer["t_hit"].numpy()
        pixels = np.flatnonzero(np.isfinite(depth))
        depth, directions = depth[pixels], directions[pixels]
        uv = answer["primitive_uvs"].numpy()[pixels]
        normals = answer["primitive_normals"].numpy()[pixels]
        away = np.einsum("ij,ij->i", normals, directions) > 0.0
        return Hits(
            pixels=pixels,
            depth=depth,
            part=self._part_of[answer["geometry_ids"].numpy()[pixels]] if len(pixels) else pixels.astype(np.int32),
            triangles=answer["primitive_ids"].numpy()[pixels],
            weights=np.stack([1.0 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1),
            points=camera_to_world.position + directions * depth[:, None],
            normals=np.where(away[:, None], -normals, normals),
        )

    def blocked(self, hits: Hits, directions: np.ndarray) -> np.ndarray:
        """Whether a mesh blocks each hit in its world direction: one for all, (3,), or one each, (n, 3). Shape (n,)."""
        rays = pack_rays(hits.points + hits.normals * np.float32(SURFACE_OFFSET_M), directions)
        return self._caster.test_occlusions(rays, nthreads=1).numpy()

    def covered(self, camera: Camera, camera_to_world: Pose) -> tuple[np.ndarray, np.ndarray]:
        """List every pair of a pixel and a mesh on its ray, hidden or not, sorted: pixels, parts."""
        hits = self._caster.list_intersections(pack_pixel_rays(camera, camera_to_world), nthreads=1)
        if not len(self._part_of):
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        count = int(self._part_of[-1]) + 1
        parts = self._part_of[hits["geometry_ids"].numpy()]
        pairs = np.unique(hits["ray_ids"].numpy().astype(np.int64) * count + parts)
        return pairs // count, pairs % count
