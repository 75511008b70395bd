"""Incremental ray casting of a scene: still surfaces are rendered once, only moving parts are cast again.

The look is that of `physics.render`: the same light and colors. Moving parts cast shadows on still surfaces and receive
none. Same input, same bytes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from schemas.geometry import Camera, Frozen, Picture, Points, Pose, TriangleMesh
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose, rotation_matrix, transform_points
from tableverse_factory.physics.render.raycast import Hits, Raycaster
from tableverse_factory.physics.render.render import (
    GAMMA,
    Lighting,
    Paint,
    Surfaces,
    compute_light,
    compute_light_maps,
    srgb_to_linear,
)
from tableverse_factory.physics.render.views import resize_camera

SAMPLES = 2  # per pixel, along each side
SKY_RAYS = 6
_LEVELS = 1 << 14
_NEAR_PLANE_M = 0.02  # a part nearer to the camera's plane than this is searched in the whole picture
_SHADOW_MARGIN_M = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class PaintedMeshes(Frozen):
    """Meshes with their paints, in the table frame or each in its own frame."""

    meshes: tuple[TriangleMesh, ...]
    paints: tuple[Paint, ...]


@dataclass(frozen=True, slots=True, eq=False)
class View(Frozen):
    """Picture with its geometry. Where subpixels see several parts, the nearest tells depth and part."""

    color: Picture  # shape (h, w, 3), sRGB
    depth: np.ndarray  # along the optical axis [m], 0 where nothing is; shape (h, w), float32
    parts: np.ndarray  # index of the still mesh, or behind those of the moving one; -1 where nothing is; shape (h, w)


class IncrementalRenderer:
    """Scene as one camera sees it, ready to be rendered with its moving parts anywhere."""

    def __init__(
        self,
        still: PaintedMeshes,
        moving: PaintedMeshes,
        eye: PosedCamera,
        lighting: Lighting | None = None,
        samples: int = SAMPLES,
        sky_rays: int = SKY_RAYS,
    ) -> None:
        """Render still meshes in the table frame; moving ones are in their own frames. Soft daylight by default.

        `samples` along each side of a pixel smooth edges, `sky_rays` darken corners of still surfaces; 1 and 0 are
        faster, for an eye that moves.
        """
        self._eye = eye
        self._lighting, self._samples, self._sky_rays = lighting or Lighting(), samples, sky_rays
        self._fine = resize_camera(eye.camera, samples * eye.camera.width)
        self._moving = [_MovingPart(mesh, paint) for mesh, paint in zip(moving.meshes, moving.paints, strict=True)]
        self._levels = np.rint(255.0 * np.linspace(0.0, 1.0, _LEVELS) ** (1 / GAMMA)).astype(np.uint8)
        self._caster, self._surfaces = Raycaster(still.meshes), Surfaces(still.meshes, still.paints)
        self._n_still = len(still.meshes)
        self._draw_still()

    def move_eye(self, camera_to_table: Pose) -> None:
        """Move the camera; still surfaces are rendered anew."""
        self._eye = replace(self._eye, camera_to_table=camera_to_table)
        self._draw_still()

    def _draw_still(self) -> None:
        pose, shape = self._eye.camera_to_table, (self._fine.height, self._fine.width)
        hits = self._caster.cast(self._fine, pose)
        normals, albedo = self._surfaces.at(hits)
        ambient, direct = compute_light(hits.points, normals, albedo, pose.position, self._lighting)
        key, sky = compute_light_maps(self._caster, hits, shape, self._lighting, True, self._sky_rays)
        images = np.zeros((2, shape[0] * shape[1], 3), dtype=np.float32)
        images[0] = srgb_to_linear(np.array(self._lighting.background))
        images[0, hits.pixels] = ambient * sky[hits.pixels, None]
        images[1, hits.pixels] = direct * key[hits.pixels, None]
        self._ambient, self._direct = (_downsample(image.reshape(*shape, 3), self._samples) for image in images)
        self._depth = np.full(shape[0] * shape[1], np.inf, dtype=np.float32)
        self._depth[hits.pixels] = hits.depth
        self._still = np.full(len(self._depth), -1, dtype=np.int32)
        self._still[hits.pixels] = hits.part
        self._ground = _ShadowReceiver(hits, self._fine, np.array(self._lighting.key_direction), self._samples)

    def render(self, poses: Sequence[Pose]) -> Picture:
        """Render the picture with each moving part at its pose in the table frame. Shape (h, w, 3) sRGB."""
        looks, _, owner = self._find_nearest(poses)
        return self._color(poses, looks, owner)

    def render_view(self, poses: Sequence[Pose]) -> View:
        """Render picture, depth and parts with each moving part at its pose in the table frame."""
        looks, depth, owner = self._find_nearest(poses)
        color = self._color(poses, looks, owner)
        return View(color, *_reduce_to_pixels(depth, owner, color.shape[:2], self._samples))

    def _color(self, poses: Sequence[Pose], looks: Sequence[Hits], owner: np.ndarray) -> Picture:
        height, width = self._eye.camera.height, self._eye.camera.width
        open_share = self._ground.open_share(self._moving, poses).reshape(height, width, 1)
        picture = (self._ambient + self._direct * open_share).reshape(-1, 3)
        pixels, colors = self._seen(poses, looks, owner)
        if len(pixels):
            rows, columns = pixels // self._fine.width // self._samples, pixels % self._fine.width // self._samples
            coarse = rows * width + columns
            covered = np.bincount(coarse, minlength=len(picture))
            total = np.stack([np.bincount(coarse, colors[:, k], len(picture)) for k in range(3)], axis=1)
            touched = np.flatnonzero(covered)
            share = (covered[touched] / self._samples**2)[:, None]
            picture[touched] = picture[touched] * (1.0 - share) + total[touched] / self._samples**2
        indices = (np.clip(picture, 0.0, 1.0) * (_LEVELS - 1)).astype(np.int32)
        return self._levels[indices].reshape(height, width, 3)

    def _find_nearest(self, poses: Sequence[Pose]) -> tuple[list[Hits], np.ndarray, np.ndarray]:
        """Find each moving part's hits, and per subpixel the least depth and the part that has it."""
        depth, owner, eye = self._depth.copy(), self._still.copy(), self._eye.camera_to_table
        looks = [part.look(self._fine, eye, pose) for part, pose in zip(self._moving, poses, strict=True)]
        for number, hits in enumerate(looks, self._n_still):
            nearer = hits.depth < depth[hits.pixels]
            depth[hits.pixels[nearer]] = hits.depth[nearer]
            owner[hits.pixels[nearer]] = number
        return looks, depth, owner

    def _seen(self, poses: Sequence[Pose], looks: Sequence[Hits], owner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find subpixels in which a moving part is nearest, and their linear colors."""
        eye = self._eye.camera_to_table
        pixels, colors = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
        for number, (part, hits, pose) in enumerate(zip(self._moving, looks, poses, strict=True), self._n_still):
            won = np.flatnonzero(owner[hits.pixels] == number)
            pixels.append(hits.pixels[won])
            colors.append(part.colors(_select_hits(hits, won), pose, eye, self._lighting))
        return np.concatenate(pixels), np.concatenate(colors)


class _MovingPart:
    """Rigid part in its own frame, with its triangle tree."""

    def __init__(self, mesh: TriangleMesh, paint: Paint) -> None:
        self.caster = Raycaster([mesh])
        self._surfaces = Surfaces([mesh], [paint])
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        self.corners: Points = np.array([[(low, high)[k >> a & 1][a] for a in range(3)] for k in range(8)])

    def look(self, camera: Camera, camera_to_table: Pose, pose: Pose) -> Hits:
        """Cast the camera's rays on the part: pixels of the whole picture, the rest in its own frame."""
        left, top, width, height = self._window(camera, camera_to_table, pose)
        if width <= 0 or height <= 0:
            return _make_empty_hits()
        window = replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=width, height=height)
        hits = self.caster.cast(window, compose_poses(invert_pose(pose), camera_to_table))
        rows, columns = np.divmod(hits.pixels, width)
        return replace(hits, pixels=(rows + top) * camera.width + columns + left)

    def _window(self, camera: Camera, camera_to_table: Pose, pose: Pose) -> tuple[int, int, int, int]:
        """Compute left, top, width and height of the pixels that it may cover."""
        seen = transform_points(compose_poses(invert_pose(camera_to_table), pose), self.corners)
        if seen[:, 2].max() <= 0.0:
            return 0, 0, 0, 0
        if seen[:, 2].min() < _NEAR_PLANE_M:
            return 0, 0, camera.width, camera.height
        x = camera.fx * seen[:, 0] / seen[:, 2] + camera.cx
        y = camera.fy * seen[:, 1] / seen[:, 2] + camera.cy
        left, top = max(int(x.min()) - 1, 0), max(int(y.min()) - 1, 0)
        return left, top, min(int(x.max()) + 2, camera.width) - left, min(int(y.max()) + 2, camera.height) - top

    def colors(self, hits: Hits, pose: Pose, camera_to_table: Pose, lighting: Lighting) -> np.ndarray:
        """Compute linear colors at hits in its own frame. Shape (n, 3)."""
        if not len(hits.pixels):
            return np.zeros((0, 3))
        normals, albedo = self._surfaces.at(hits)
        turned = normals @ rotation_matrix(pose.quaternion_wxyz).T
        points = transform_points(pose, hits.points)
        ambient, direct = compute_light(points, turned, albedo, camera_to_table.position, lighting)
        return ambient + direct


class _ShadowReceiver:
    """Still surfaces that moving parts may shadow, one point per pixel."""

    def __init__(self, hits: Hits, fine: Camera, to_light: np.ndarray, samples: int) -> None:
        rows, columns = np.divmod(hits.pixels, fine.width)
        here = np.flatnonzero((rows % samples == 0) & (columns % samples == 0))
        self._to_light = to_light / np.linalg.norm(to_light)
        side = np.cross(self._to_light, [0.0, 1.0, 0.0])
        side /= np.linalg.norm(side)
        self._axes = np.stack([side, np.cross(self._to_light, side)], axis=1)
        flat = hits.points[here] @ self._axes
        order = np.argsort(flat[:, 0], kind="stable")
        here, flat = here[order], flat[order]
        self._hits = _select_hits(hits, here)
        self._across, self._along = np.ascontiguousarray(flat[:, 0]), np.ascontiguousarray(flat[:, 1])
        self._shape = fine.height // samples, fine.width // samples
        self._pixels = rows[here] // samples * self._shape[1] + columns[here] // samples

    def open_share(self, parts: Sequence[_MovingPart], poses: Sequence[Pose]) -> np.ndarray:
        """Compute the share of the key light that moving parts let through, per pixel. Shape (h * w,)."""
        blocked = np.zeros(len(self._pixels), dtype=bool)
        for part, pose in zip(parts, poses, strict=True):
            near = self._behind(transform_points(pose, part.corners), blocked)
            if len(near):
                turn = rotation_matrix(pose.quaternion_wxyz)
                points = (self._hits.points[near] - pose.position) @ turn
                start = replace(_select_hits(self._hits, near), points=points, normals=self._hits.normals[near] @ turn)
                blocked[near] = part.caster.blocked(start, self._to_light @ turn)
        share = np.ones(self._shape, dtype=np.float32)
        share.reshape(-1)[self._pixels[blocked]] = 0.0
        return _blur(share).reshape(-1)

    def _behind(self, corners: Points, blocked: np.ndarray) -> np.ndarray:
        """Find unshadowed points in a box's outline as seen from the light."""
        flat = corners @ self._axes
        low, high = flat.min(axis=0) - _SHADOW_MARGIN_M, flat.max(axis=0) + _SHADOW_MARGIN_M
        first, last = np.searchsorted(self._across, [low[0], high[0]])
        along = self._along[first:last]
        return first + np.flatnonzero((along >= low[1]) & (along <= high[1]) & ~blocked[first:last])


def _blur(image: np.ndarray) -> np.ndarray:
    """Average over 3 x 3 pixels, the edge repeated."""
    for axis in (0, 1):
        size = image.shape[axis]
        before = np.take(image, np.maximum(np.arange(size) - 1, 0), axis)
        after = np.take(image, np.minimum(np.arange(size) + 1, size - 1), axis)
        image = (before + image + after) / np.float32(3.0)
    return image


def _reduce_to_pixels(
    depth: np.ndarray, owner: np.ndarray, shape: tuple[int, ...], samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Reduce subpixels to the nearest part of each pixel, and its mean depth there. Both of shape (h, w)."""
    height, width = shape
    split = height, samples, width, samples
    near, parts = (values.reshape(split).transpose(0, 2, 1, 3).reshape(height, width, -1) for values in (depth, owner))
    part = np.take_along_axis(parts, near.argmin(axis=2)[..., None], axis=2)
    mine = (parts == part) & np.isfinite(near)
    total = np.where(mine, near, 0.0).sum(axis=2)
    return (total / np.maximum(mine.sum(axis=2), 1)).astype(np.float32), part[..., 0]


def _downsample(image: np.ndarray, samples: int) -> np.ndarray:
    height, width = (side // samples for side in image.shape[:2])
    return image.reshape(height, samples, width, samples, -1).mean(axis=(1, 3))


def _select_hits(hits: Hits, indices: np.ndarray) -> Hits:
    return Hits(*(getattr(hits, field.name)[indices] for field in fields(Hits)))


def _make_empty_hits() -> Hits:
    none, three = np.zeros(0, dtype=np.int64), np.zeros((0, 3), dtype=np.float32)
    return Hits(none, np.zeros(0, dtype=np.float32), none, none, three, np.zeros((0, 3)), three)
