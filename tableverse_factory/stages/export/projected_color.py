"""Projection of the picture's colours onto a surface."""

import io
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from PIL import Image
from scipy import ndimage

from schemas.geometry import Camera, Frozen, Mask, Picture, Points, Pose, TriangleMesh
from schemas.objects import Evidence
from tableverse_factory.geometry.math.camera import project
from tableverse_factory.geometry.math.transforms import (
    compose_poses,
    identity_pose,
    invert_pose,
    transform_points,
)
from tableverse_factory.geometry.mesh.hulls import cross_rows
from tableverse_factory.geometry.mesh.occluding_edges import find_behind_edges
from tableverse_factory.geometry.mesh.raycasting import RaycastingScene, make_raycasting_scene, pack_rays

LEAST_FACING = 0.2  # least cosine between normal and line of sight; pixels of steeper faces are too stretched
BORDER_PIXELS = 2  # width of the outline whose pixels mix the object with its background [px]
SAME_SURFACE = 0.004  # share of the distance by which the first surface on the line to a visible point may be nearer


@dataclass(frozen=True, slots=True, eq=False)
class ColorProjector(Frozen):
    """The picture, relative to one object; `own` are the pixels that show it alone, its mesh is at `scale`.

    Where a sensor measured the depth, the mesh meets its edges in the picture; else it `misses_edges` a little.
    """

    color: Picture
    own: Mask
    camera: Camera
    object_to_camera: Pose
    scale: float
    misses_edges: bool

    @property
    def texels_per_metre(self) -> float:
        """Pixels per metre of the mesh's own length at the object's distance."""
        return self.camera.fx * self.scale / max(float(self.object_to_camera.position[2]), 0.05)


def load_projectors(evidence: Evidence, poses: list[Pose], scales: list[float]) -> list[ColorProjector]:
    """Decode the picture and prepare it for each object, at its placed pose."""
    color = np.asarray(Image.open(io.BytesIO(evidence.color_jpg)).convert("RGB"))
    ids = np.asarray(Image.open(io.BytesIO(evidence.masks_png))).astype(np.int64)
    table_to_camera = invert_pose(evidence.camera_to_table)
    return [
        ColorProjector(
            color,
            ndimage.binary_erosion(ids == value, iterations=BORDER_PIXELS)
            if value > 0
            else np.zeros(ids.shape, dtype=bool),
            evidence.camera,
            compose_poses(table_to_camera, pose),
            scale,
            evidence.scale_source != "sensor",
        )
        for value, pose, scale in zip(evidence.object_pixels, poses, scales, strict=True)
    ]


class PhotographedMesh:
    """A mesh where it was placed before the camera, to find what the picture shows of its surface."""

    def __init__(self, photograph: ColorProjector, mesh: TriangleMesh) -> None:
        self._photograph = photograph
        placed = transform_points(photograph.object_to_camera, mesh.vertices, photograph.scale)
        a, b, c = (placed[mesh.faces[:, k]] for k in range(3))
        self._normals = cross_rows(b - a, c - a)
        self._scene = make_raycasting_scene(TriangleMesh(placed, mesh.faces))
        self._own = _remove_edges(photograph, self._scene)

    def find_shown(
        self, points: Points, faces: np.ndarray
    ) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, "k 2"]]:
        """Find which points of the surface the picture shows: their indices and pixels.

        Points are in the mesh's own frame, before scale, shape (n, 3); `faces` are those they lie on, shape (n,).
        """
        photograph = self._photograph
        at = transform_points(photograph.object_to_camera, points, photograph.scale)
        normals = self._normals[faces]
        lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(at, axis=1)
        facing = -np.einsum("ij,ij->i", normals, at) > LEAST_FACING * np.maximum(lengths, 1e-30)
        shown = np.flatnonzero(facing)
        pixels = project(at[shown], photograph.camera)
        nearest = np.rint(np.nan_to_num(pixels, nan=-1.0, posinf=-1.0, neginf=-1.0)).astype(np.int64)
        height, width = self._own.shape
        inside = ((nearest >= 0) & (nearest < [width, height])).all(axis=1)
        u, v = np.clip(nearest, 0, [width - 1, height - 1]).T
        inside &= self._own[v, u]
        shown, pixels = shown[inside], pixels[inside]
        # A point is visible if no other part of the mesh is nearer on its line of sight.
        rays = pack_rays(np.zeros(3), at[shown])
        visible = ~self._scene.test_occlusions(rays, tfar=1.0 - SAME_SURFACE, nthreads=1).numpy()
        return shown[visible], pixels[visible]

    def sample_colors(self, pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
        """Sample the picture's sRGB at pixels."""
        return sample_bilinear(self._photograph.color, pixels)

    @property
    def texels_per_metre(self) -> float:
        """Pixels per metre of the mesh's own length."""
        return self._photograph.texels_per_metre


def _remove_edges(photograph: ColorProjector, scene: RaycastingScene) -> Mask:
    """Remove the object's pixels just behind edges that its mesh misses: what is before them may show there."""
    own = photograph.own.copy()
    if not photograph.misses_edges or not own.any():
        return own
    (rows, columns), camera = ndimage.find_objects(own.astype(np.uint8))[0], photograph.camera
    size = columns.stop - columns.start, rows.stop - rows.start
    window = Camera(camera.fx, camera.fy, camera.cx - columns.start, camera.cy - rows.start, *size)
    own[rows, columns] &= ~find_behind_edges(scene, window, identity_pose(), own[rows, columns])
    return own


def sample_bilinear(picture: Picture, pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    """Sample sRGB at pixels (u, v), which are clipped to the picture."""
    height, width = picture.shape[:2]
    u, v = np.clip(pixels, 0, [width - 1, height - 1]).T
    left, top = np.minimum(u.astype(np.int64), width - 2), np.minimum(v.astype(np.int64), height - 2)
    right_share, low_share = (u - left)[:, None], (v - top)[:, None]
    upper = picture[top, left] * (1 - right_share) + picture[top, left + 1] * right_share
    lower = picture[top + 1, left] * (1 - right_share) + picture[top + 1, left + 1] * right_share
    return upper * (1 - low_share) + lower * low_share
