"""Ray-cast rendering of meshes on the CPU: no GL, no display, the same bytes on every machine of a kind.

Rays are cast by Embree, shading is numpy: a soft key light with shadow rays, a hemispheric sky with occlusion rays,
both smoothed over neighbouring pixels of the same surface, and smooth normals where neighbouring faces agree.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from schemas.geometry import Camera, Frozen, IdImage, Picture, Points, Pose, Texture, TriangleMesh, Vector3
from tableverse_factory.geometry.math.transforms import quaternion_from_matrix
from tableverse_factory.geometry.mesh.texels import fold_uv
from tableverse_factory.physics.render.normals import compute_corner_normals
from tableverse_factory.physics.render.raycast import Hits, Raycaster

Rgb = tuple[float, float, float]
Pattern = Callable[[Points], Float64[np.ndarray, "n 3"]]  # world positions [m] to sRGB in 0–255, point by point
Paint = Rgb | Pattern | None  # sRGB in 0–255, a pattern, or None: the mesh's own texture or vertex colours, else grey

_GREY: Rgb = (178.0, 178.0, 184.0)
GAMMA = 2.2
_KEY_RAYS = 4
_GOLDEN_ANGLE = float(np.pi * (3.0 - np.sqrt(5.0)))


@dataclass(frozen=True, slots=True)
class Lighting:
    """Light in linear RGB, 1.0 being a white surface at full exposure: a key light, sky from +z, ground from -z.

    Attributes:
        key_direction: From the scene towards the key light, any length.
        key_radius: Half the angle under which the key light is seen [rad]: softens shadows.
        gloss: Strength of the highlight of the key light, 0 for matt.
        background: sRGB in 0–255 where nothing is hit.
    """

    key_direction: Rgb = (-0.45, -0.55, 1.0)
    key: Rgb = (0.62, 0.60, 0.56)
    key_radius: float = 0.06
    sky: Rgb = (0.46, 0.48, 0.52)
    ground: Rgb = (0.22, 0.21, 0.20)
    gloss: float = 0.06
    background: Rgb = (236.0, 238.0, 242.0)


@dataclass(frozen=True, slots=True, eq=False)
class Rendering(Frozen):
    """Images of a pinhole camera.

    Attributes:
        depth: Distance along the optical axis [m]; 0 where nothing is hit.
        ids: Index of the part that is seen; -1 where nothing is hit.
        normals: Unit normals of the faces in the world frame, towards the eye; 0 where nothing is hit.
    """

    color: Picture
    depth: Float32[np.ndarray, "h w"]
    ids: IdImage
    normals: Float32[np.ndarray, "h w 3"]


def look_at(eye: Vector3, target: Vector3, up: Vector3 | None = None) -> Pose:
    """The camera-to-world pose (OpenCV axes: x right, y down, z forward) of an eye that looks at a target [m].

    `up` points up in the picture, +z by default; looking along it, +y is used instead. ValueError if the points
    coincide.
    """
    eye = np.asarray(eye, dtype=np.float64)
    forward = np.asarray(target, dtype=np.float64) - eye
    length = float(np.linalg.norm(forward))
    if not length > 1e-9:
        raise ValueError(f"eye {eye.tolist()} and target coincide: give two different points")
    forward = forward / length
    upward = np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, dtype=np.float64)
    right = np.cross(forward, upward)
    if float(np.linalg.norm(right)) < 1e-6 * float(np.linalg.norm(upward)):
        right = np.cross(forward, [0.0, 1.0, 0.0] if abs(forward[1]) < 0.9 else [1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    return Pose(eye, quaternion_from_matrix(np.stack([right, np.cross(forward, right), forward], axis=1)))


def render(
    parts: Sequence[TriangleMesh],
    camera: Camera,
    camera_to_world: Pose,
    *,
    paints: Sequence[Paint] | None = None,
    lighting: Lighting | None = None,
    shadows: bool = True,
    sky_rays: int = 0,
    samples: int = 1,
) -> Rendering:
    """Render meshes in the world frame (z up).

    Depth, ids and normals are taken at pixel centres; colour is the mean of `samples` x `samples` rays per pixel.

    Args:
        parts: Meshes in the world frame [m]; a part without faces is allowed and never seen.
        camera: Intrinsics and size of the picture.
        camera_to_world: Pose of the camera, OpenCV axes.
        paints: One per part; by default every mesh has its own colours.
        lighting: Key light and sky; soft daylight by default.
        shadows: Whether shadow rays are cast to the key light.
        sky_rays: Ambient occlusion rays per pixel; 0 for none, 6 to 12 look good.
        samples: Side of the grid of samples in a pixel; 2 antialiases.

    Raises:
        ValueError: if `paints` is not as long as `parts`, or `samples` is not positive.
    """
    views = ((camera, camera_to_world),)
    return render_views(
        parts, views, paints=paints, lighting=lighting, shadows=shadows, sky_rays=sky_rays, samples=samples
    )[0]


def render_views(
    parts: Sequence[TriangleMesh],
    views: Sequence[tuple[Camera, Pose]],
    *,
    paints: Sequence[Paint] | None = None,
    lighting: Lighting | None = None,
    shadows: bool = True,
    sky_rays: int = 0,
    samples: int = 1,
) -> tuple[Rendering, ...]:
    """Render one picture per camera and its pose in the world; shared data is prepared once (see `render`)."""
    paints = [None] * len(parts) if paints is None else paints
    if len(paints) != len(parts):
        raise ValueError(f"{len(paints)} paints for {len(parts)} parts: give one each")
    if samples < 1:
        raise ValueError(f"samples is {samples}: give 1 or more")
    lighting = lighting or Lighting()
    caster = Raycaster(parts)
    surfaces = Surfaces(parts, paints)
    return tuple(
        _render_view(caster, surfaces, camera, pose, lighting, shadows, sky_rays, samples) for camera, pose in views
    )


def _render_view(
    caster: Raycaster,
    surfaces: "Surfaces",
    camera: Camera,
    camera_to_world: Pose,
    lighting: Lighting,
    shadows: bool,
    sky_rays: int,
    samples: int,
) -> Rendering:
    center = caster.cast(camera, camera_to_world)
    shape = (camera.height, camera.width)
    key_light, sky_light = compute_light_maps(caster, center, shape, lighting, shadows, sky_rays)
    linear = np.zeros((camera.height * camera.width, 3))
    for index in range(samples * samples):
        offset = ((index % samples + 0.5) / samples - 0.5, (index // samples + 0.5) / samples - 0.5)
        hits = center if samples == 1 else caster.cast(camera, camera_to_world, offset)
        seen = np.broadcast_to(srgb_to_linear(np.array(lighting.background)), linear.shape).copy()
        normals, albedo = surfaces.at(hits)
        ambient, direct = compute_light(hits.points, normals, albedo, camera_to_world.position, lighting)
        seen[hits.pixels] = ambient * sky_light[hits.pixels, None] + direct * key_light[hits.pixels, None]
        linear += seen
    color = np.rint(255.0 * np.clip(linear / samples**2, 0.0, 1.0) ** (1 / GAMMA)).astype(np.uint8)
    depth, ids = np.zeros(linear.shape[0], dtype=np.float32), np.full(linear.shape[0], -1, dtype=np.int32)
    normals = np.zeros((linear.shape[0], 3), dtype=np.float32)
    depth[center.pixels], ids[center.pixels], normals[center.pixels] = center.depth, center.part, center.normals
    return Rendering(color.reshape(*shape, 3), depth.reshape(shape), ids.reshape(shape), normals.reshape(*shape, 3))


class Surfaces:
    """Smooth normals and colours of meshes at hits."""

    def __init__(self, parts: Sequence[TriangleMesh], paints: Sequence[Paint]) -> None:
        self._parts = parts
        self._paints = paints
        self._corner_normals: dict[int, Float32[np.ndarray, "m 3 3"]] = {}

    def at(self, hits: Hits) -> tuple[np.ndarray, np.ndarray]:
        """Compute unit normals towards the eye, and linear colours. Both of shape (n, 3)."""
        normals, albedo = np.empty_like(hits.normals), np.empty_like(hits.points)
        for index in np.flatnonzero(np.bincount(hits.part, minlength=len(self._parts))):
            here = np.flatnonzero(hits.part == index)
            triangles, weights = hits.triangles[here], hits.weights[here]
            normals[here] = np.einsum("nk,nkd->nd", weights, self._corners(int(index))[triangles])
            albedo[here] = self._albedo(int(index), triangles, weights, hits.points[here])
        normals = np.where(_dot(normals, hits.normals)[:, None] < 0.0, -normals, normals)
        return _normalize(normals), albedo

    def _corners(self, index: int) -> Float32[np.ndarray, "m 3 3"]:
        if index not in self._corner_normals:
            self._corner_normals[index] = compute_corner_normals(self._parts[index])
        return self._corner_normals[index]

    def _albedo(self, index: int, triangles: np.ndarray, weights: np.ndarray, points: Points) -> np.ndarray:
        mesh, paint = self._parts[index], self._paints[index]
        if callable(paint):
            return srgb_to_linear(paint(points))
        if paint is None and mesh.texture is not None:
            return _sample_texture(mesh.texture, triangles, weights)
        if paint is None and mesh.vertex_colors is not None:
            corners = mesh.vertex_colors[mesh.faces[triangles]].astype(np.float64)
            return srgb_to_linear(np.einsum("nk,nkd->nd", weights, corners))
        return np.broadcast_to(srgb_to_linear(np.array(paint or _GREY)), points.shape)


def _sample_texture(texture: Texture, triangles: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Sample linear colours of points on faces, bilinearly; the texture repeats. Shape (n, 3)."""
    height, width = texture.picture.shape[:2]
    uv = fold_uv(np.einsum("nk,nkd->nd", weights, texture.corner_uv[triangles]))
    x = np.clip(uv[:, 0] * width - 0.5, 0.0, width - 1.0)
    y = np.clip((1.0 - uv[:, 1]) * height - 0.5, 0.0, height - 1.0)
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    along, down = (x - left)[:, None], (y - top)[:, None]
    texels = texture.picture  # linearised after the look-up: a picture has many more
    upper = (1.0 - along) * _LINEAR[texels[top, left]] + along * _LINEAR[texels[top, right]]
    lower = (1.0 - along) * _LINEAR[texels[bottom, left]] + along * _LINEAR[texels[bottom, right]]
    return (1.0 - down) * upper + down * lower


def compute_light(
    points: Points, normals: np.ndarray, albedo: np.ndarray, eye: Vector3, lighting: Lighting
) -> tuple[np.ndarray, np.ndarray]:
    """Compute linear colours that the open sky and the unoccluded key light give surface points. Both (n, 3).

    `points` and `eye` are in the world frame [m]; `normals` have length 1, towards the eye; `albedo` is linear.
    """
    to_light = _normalize(np.array(lighting.key_direction))
    facing = np.maximum(normals @ to_light, 0.0)[:, None]
    up, down = 0.5 + 0.5 * normals[:, 2:3], 0.5 - 0.5 * normals[:, 2:3]
    key = np.array(lighting.key)
    half = _normalize(_normalize(eye - points) + to_light)
    shine = lighting.gloss * np.maximum(_dot(normals, half), 0.0)[:, None] ** 48 * (facing > 0.0)
    ambient = albedo * (up * np.array(lighting.sky) + down * np.array(lighting.ground))
    return ambient, albedo * (facing * key) + shine * key


def compute_light_maps(
    caster: Raycaster, center: Hits, shape: tuple[int, int], lighting: Lighting, shadows: bool, sky_rays: int
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the share of the key light and of the sky that reaches each pixel, 0–1. Both of shape (h * w,).

    Neighbouring pixels cast rays in different directions; the mean over the neighbourhood is smooth at few rays each.
    """
    maps = np.ones((2, shape[0] * shape[1]), dtype=np.float32)
    turn = _pixel_turns(center.pixels, shape[1])
    if shadows and len(center.pixels):
        open_rays = np.zeros(len(center.pixels), dtype=np.float32)
        for k in range(_KEY_RAYS):
            radius = lighting.key_radius * np.sqrt((k + 0.5) / _KEY_RAYS)
            toward = _cone_directions(np.array(lighting.key_direction), radius, turn + k * _GOLDEN_ANGLE)
            open_rays += ~caster.blocked(center, toward)
        maps[0, center.pixels] = open_rays / _KEY_RAYS
    if sky_rays > 0 and len(center.pixels):
        # Light bounces: no corner is darker than a quarter.
        maps[1, center.pixels] = 0.25 + 0.75 * _measure_openness(caster, center, turn, sky_rays)
    if shadows or sky_rays > 0:
        maps = _smooth_maps(maps, center, shape)
    return maps[0], maps[1]


def _measure_openness(caster: Raycaster, center: Hits, turn: np.ndarray, sky_rays: int) -> np.ndarray:
    """Measure the cosine-weighted share of the upper hemisphere that each hit sees. Shape (n,)."""
    seen, total = (np.full(len(turn), 1e-6, dtype=np.float32) for _ in range(2))
    for k in range(sky_rays):
        height = (k + 0.5) / sky_rays
        radius, angle = np.sqrt(1.0 - height * height), turn + k * _GOLDEN_ANGLE
        toward = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full_like(angle, height)], axis=1)
        weight = np.maximum(_dot(center.normals, toward), 0.0)
        seen += weight * ~caster.blocked(center, toward)
        total += weight
    return seen / total


def _smooth_maps(maps: np.ndarray, center: Hits, shape: tuple[int, int]) -> np.ndarray:
    """Average over neighbouring pixels of the same part and orientation: 3 x 3, then 3 x 3 of every second pixel."""
    ids, normals = np.full(shape, -1, dtype=np.int32), np.zeros((*shape, 3), dtype=np.float32)
    ids.reshape(-1)[center.pixels], normals.reshape(-1, 3)[center.pixels] = center.part, center.normals
    images = maps.reshape(len(maps), *shape)
    for step in (1, 2):
        total, weight = images.copy(), np.ones(shape, dtype=np.float32)
        for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
            here, there = _neighbour_slices(shape, dy * step, dx * step)
            alike = (ids[here] == ids[there]) & (_dot(normals[here], normals[there]) > 0.9)
            total[:, *here] += alike * images[:, *there]
            total[:, *there] += alike * images[:, *here]
            weight[here] += alike
            weight[there] += alike
        images = total / weight
    return images.reshape(len(maps), -1)


def _neighbour_slices(shape: tuple[int, int], dy: int, dx: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices of the pixels that have a neighbour at (dy, dx), dy >= 0, and of those neighbours."""
    height, width = shape
    rows = slice(0, height - dy), slice(dy, height)
    columns = (slice(0, width - dx), slice(dx, width)) if dx >= 0 else (slice(-dx, width), slice(0, width + dx))
    return (rows[0], columns[0]), (rows[1], columns[1])


def _normalize(vectors: np.ndarray) -> np.ndarray:
    length = np.sqrt(_dot(vectors, vectors))[..., None]
    return vectors / np.where(length > 0.0, length, 1.0)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)


def srgb_to_linear(srgb: np.ndarray) -> np.ndarray:
    """Convert sRGB in 0–255 to linear RGB in 0–1."""
    return np.clip(srgb / 255.0, 0.0, 1.0) ** GAMMA


_LINEAR = srgb_to_linear(np.arange(256))  # look-up table of linear light for a byte


def _pixel_turns(pixels: np.ndarray, width: int) -> np.ndarray:
    """An angle per pixel [rad], well spread over a neighbourhood: interleaved gradient noise (Jimenez, 2014)."""
    v, u = np.divmod(pixels, width)
    return 2 * np.pi * ((52.9829189 * ((0.06711056 * u + 0.00583715 * v) % 1.0)) % 1.0)


def _cone_directions(direction: Vector3, radius: float, turn: np.ndarray) -> Points:
    """Unit directions on a cone of `radius` [rad] about an axis, one per turn. Shape (n, 3)."""
    axis = _normalize(direction)
    side = _normalize(np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0]))
    across = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side)
    return _normalize(axis + radius * across)
