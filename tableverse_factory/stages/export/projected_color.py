"""Projection of the picture's colours onto a surface."""

import io
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from PIL import Image
from scipy.ndimage import binary_erosion

from schemas.geometry import Camera, Frozen, Mask, Picture, Points, Pose, TriangleMesh
from schemas.objects import Evidence
from tableverse_factory.geometry.math.camera import project
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose, transform_points
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene, pack_rays

LEAST_FACING = 0.2  # least cosine between normal and line of sight; pixels of steeper faces are too stretched
BORDER_PIXELS = 2  # width of the outline whose pixels mix the object with its background [px]
SAME_SURFACE = 0.004  # share of the distance by which the first surface on the line to a visible point may be nearer


@dataclass(frozen=True, slots=True, eq=False)
class ColorProjector(Frozen):
    """The picture, relative to one object; `own` are the pixels that show it alone, its mesh is at `scale`."""

    color: Picture
    own: Mask
    camera: Camera
    object_to_camera: Pose
    scale: float

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
            binary_erosion(ids == value, iterations=BORDER_PIXELS) if value > 0 else np.zeros(ids.shape, dtype=bool),
            evidence.camera,
            compose_poses(table_to_camera, pose),
            scale,
        )
        for value, pose, scale in zip(evidence.object_pixels, poses, scales, strict=True)
    ]


def project_colors(
    photograph: ColorProjector, mesh: TriangleMesh, points: Points, faces: np.ndarray
) -> tuple[Bool[np.ndarray, " n"], Float64[np.ndarray, "n 3"]]:
    """Find which points of the mesh's surface the picture shows, and their sRGB there.

    Points are in the mesh's own frame, before scale, shape (n, 3); `faces` are those they lie on, shape (n,).
    """
    pose, scale = photograph.object_to_camera, photograph.scale
    placed = transform_points(pose, mesh.vertices, scale)
    at = transform_points(pose, points, scale)
    corners = placed[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[faces]
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(at, axis=1)
    facing = -np.einsum("ij,ij->i", normals, at) > LEAST_FACING * np.maximum(lengths, 1e-30)
    pixels = project(at, photograph.camera)
    nearest = np.rint(np.nan_to_num(pixels, nan=-1.0, posinf=-1.0, neginf=-1.0)).astype(np.int64)
    height, width = photograph.own.shape
    inside = ((nearest >= 0) & (nearest < [width, height])).all(axis=1)
    u, v = np.clip(nearest, 0, [width - 1, height - 1]).T
    seen = facing & inside & photograph.own[v, u]
    # A point is visible if no other part of the mesh is nearer on its line of sight.
    scene = make_raycasting_scene(TriangleMesh(placed, mesh.faces))
    first = scene.cast_rays(pack_rays(np.zeros(3), at[seen]), nthreads=1)["t_hit"].numpy()
    seen[seen] = first > 1.0 - SAME_SURFACE
    colors = np.zeros((len(points), 3))
    colors[seen] = _sample_bilinear(photograph.color, pixels[seen])
    return seen, colors


def _sample_bilinear(picture: Picture, pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
    height, width = picture.shape[:2]
    u, v = np.clip(pixels, 0, [width - 1, height - 1]).T
    left, top = np.minimum(u.astype(np.int64), width - 2), np.minimum(v.astype(np.int64), height - 2)
    right_share, low_share = (u - left)[:, None], (v - top)[:, None]
    upper = picture[top, left] * (1 - right_share) + picture[top, left + 1] * right_share
    lower = picture[top + 1, left] * (1 - right_share) + picture[top + 1, left + 1] * right_share
    return upper * (1 - low_share) + lower * low_share
