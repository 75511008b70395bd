"""Table and background as the picture shows them, without the objects, for scenes that look like their photograph."""

import io

import numpy as np
from jaxtyping import Float64
from PIL import Image
from scipy import ndimage

from schemas.geometry import Mask, Picture
from schemas.objects import Evidence
from tableverse_factory.core.png import encode_png
from tableverse_factory.geometry.math.camera import project
from tableverse_factory.geometry.math.transforms import invert_pose, rotation_matrix, transform_points
from tableverse_factory.physics.mjcf.slab import THICKNESS_M, Slab
from tableverse_factory.physics.mjcf.spec import Backdrop, TableTexture, compute_irradiance
from tableverse_factory.stages.export.projected_color import sample_bilinear

MAX_SIDE_PX = 1024  # longest side of a texture
OUTLINE_SHARE = 0.01  # of the picture's width: around an object, the picture mixes it with what is behind
BEHIND = 1.05  # depth of the backdrop over that of the table's farthest corner

_Colors = Float64[np.ndarray, "h w 3"]


def photograph_table(evidence: Evidence, slab: Slab) -> TableTexture:
    """Rectify the picture onto the table; what objects hide, and what lies outside the picture, is filled smoothly."""
    picture, covered = _decode(evidence)
    side = 2 * slab.half_size_xy
    eye = invert_pose(evidence.camera_to_table)
    texel = max(float(side.max()) / MAX_SIDE_PX, _measure_pixel(evidence, slab))
    width, height = np.maximum(np.ceil(side / texel), 2.0).astype(int)
    # The texture's rows run against the slab's y axis.
    along = ((np.arange(width) + 0.5) / width - 0.5) * side[0], (0.5 - (np.arange(height) + 0.5) / height) * side[1]
    points = slab.to_table(np.stack(np.meshgrid(*along), axis=-1).reshape(-1, 2))
    pixels = project(transform_points(eye, points), evidence.camera)
    last = np.array(covered.shape[::-1]) - 1
    inside = np.flatnonzero(((pixels >= 0) & (pixels <= last)).all(axis=1))
    u, v = np.rint(pixels[inside]).astype(np.int64).T
    seen = inside[~covered[v, u]]
    colors, known = np.zeros((height * width, 3)), np.zeros(height * width, dtype=bool)
    colors[seen], known[seen] = sample_bilinear(picture, pixels[seen]), True
    filled = _fill(colors.reshape(height, width, 3), known.reshape(height, width))
    to_eye = evidence.camera_to_table.position - np.array([*slab.center_xy, 0.0])
    light = compute_irradiance(np.array([0.0, 0.0, 1.0]), to_eye / np.linalg.norm(to_eye))
    return TableTexture(_encode(filled), (float(side[0]), float(side[1])), 1.0 / light)


def photograph_backdrop(evidence: Evidence, slab: Slab) -> Backdrop:
    """Stand the picture, its objects painted over, behind the table where the camera sees it in its place."""
    picture, covered = _decode(evidence)
    camera, size = evidence.camera, np.array(covered.shape[::-1], dtype=np.float64)
    corners = slab.to_table(np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * slab.half_size_xy)
    corners = np.concatenate([corners, corners - [0.0, 0.0, THICKNESS_M]])
    depth = BEHIND * float(transform_points(invert_pose(evidence.camera_to_table), corners)[:, 2].max())
    focal = np.array([camera.fx, camera.fy])
    middle = ((size - 1) / 2 - [camera.cx, camera.cy]) / focal * depth
    center = transform_points(evidence.camera_to_table, np.array([[*middle, depth]]))[0]
    filled = _fill(picture.astype(np.float64), ~covered)
    to_eye = -rotation_matrix(evidence.camera_to_table.quaternion_wxyz)[:, 2]
    tint = 1.0 / compute_irradiance(to_eye, to_eye)
    half_size = size / focal * depth / 2
    return Backdrop(_encode(filled), center, evidence.camera_to_table.quaternion_wxyz, half_size, tint)


def _decode(evidence: Evidence) -> tuple[Picture, Mask]:
    """Decode the picture, and where objects cover what is behind."""
    picture = np.asarray(Image.open(io.BytesIO(evidence.color_jpg)).convert("RGB"))
    masks = np.asarray(Image.open(io.BytesIO(evidence.masks_png)))
    outline = max(1, round(OUTLINE_SHARE * picture.shape[1]))
    return picture, ndimage.binary_dilation(masks > 0, iterations=outline)


def _measure_pixel(evidence: Evidence, slab: Slab) -> float:
    """Measure a pixel of the picture at the table's middle, in its plane [m]."""
    middle = slab.to_table(np.zeros((1, 2)))
    distance = float(transform_points(invert_pose(evidence.camera_to_table), middle)[0, 2])
    return max(distance, 0.05) / evidence.camera.fx


def _fill(colors: _Colors, known: Mask) -> _Colors:
    """Fill unknown pixels smoothly from those around, by push and pull (Gortler et al. 1996)."""
    if known.all() or not known.any():
        return colors
    height, width = known.shape
    even = ((0, height % 2), (0, width % 2))
    weight = np.pad(known.astype(np.float64), even)
    blocks = (weight.shape[0] // 2, 2, weight.shape[1] // 2, 2)
    total = weight.reshape(blocks).sum(axis=(1, 3))
    sums = (np.pad(colors, (*even, (0, 0))) * weight[..., None]).reshape(*blocks, 3).sum(axis=(1, 3))
    coarse = _fill(sums / np.maximum(total, 1.0)[..., None], total > 0)
    fine = ndimage.zoom(coarse, (2, 2, 1), order=1, mode="nearest", grid_mode=True)[:height, :width]
    return np.where(known[..., None], colors, fine)


def _encode(colors: _Colors) -> bytes:
    image = Image.fromarray(np.rint(np.clip(colors, 0, 255)).astype(np.uint8))
    image.thumbnail((MAX_SIDE_PX, MAX_SIDE_PX))
    return encode_png(image, compress_level=6)
