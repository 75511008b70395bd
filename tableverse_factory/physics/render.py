"""Pictures of meshes by ray casting on the CPU: no GL, no display, the same bytes on every machine of a kind.

Rays are cast by Embree (through Open3D's `RaycastingScene`), shading is numpy: one key light with optional shadow
rays, a hemispheric sky with optional occlusion rays, and smooth normals where neighbouring faces agree.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from jaxtyping import Float32, Float64

from schemas.geometry import Camera, Frozen, IdImage, Picture, Points, Pose, TriangleMesh, Vector3
from tableverse_factory.geometry.transforms import quaternion_from_matrix, rotation_matrix

Rgb = tuple[float, float, float]
Texture = Callable[[Points], Float64[np.ndarray, "n 3"]]
"""World positions [m] to sRGB in 0–255, point by point."""
Paint = Rgb | Texture | None
"""One sRGB colour in 0–255, a texture, or None: the mesh's own vertex colours, grey where it has none."""

_GREY: Rgb = (178.0, 178.0, 184.0)
_CREASE_COS = float(np.cos(np.deg2rad(42.0)))
_MAX_VALENCE = 256
_GAMMA = 2.2
_GOLDEN_ANGLE = float(np.pi * (3.0 - np.sqrt(5.0)))


@dataclass(frozen=True, slots=True)
class Lighting:
    """Light in linear RGB, 1.0 being a white surface at full exposure.

    Attributes:
        key_direction: From the scene towards the key light, any length.
        key: Radiance of the key light on a surface that faces it.
        key_radius: Half the angle under which the key light is seen [rad]: softens shadows where samples > 1.
        sky: Ambient light from +z.
        ground: Ambient light from -z.
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
    """What a pinhole camera sees; all images have the camera's size.

    Attributes:
        color: Shape (h, w, 3) sRGB.
        depth: Shape (h, w) float32, distance along the optical axis [m]; 0 where nothing is hit.
        ids: Shape (h, w) int32, index of the part that is seen; -1 where nothing is hit.
        normals: Shape (h, w, 3) float32, unit normals of the faces in the world frame, towards the eye; 0 on a miss.
    """

    color: Picture
    depth: Float32[np.ndarray, "h w"]
    ids: IdImage
    normals: Float32[np.ndarray, "h w 3"]


def look_at(eye: Vector3, target: Vector3, up: Vector3 | None = None) -> Pose:
    """The camera-to-world pose (OpenCV axes: x right, y down, z forward) of an eye that looks at a target.

    Args:
        eye: Position of the camera [m]. Shape (3,).
        target: A point on the optical axis [m]. Shape (3,).
        up: World direction that points up in the picture; +z by default. Looking along it, +y is used instead.

    Raises:
        ValueError: if eye and target coincide.
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
        right = np.cross(forward, np.array([0.0, 1.0, 0.0] if abs(forward[1]) < 0.9 else [1.0, 0.0, 0.0]))
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
    """Renders meshes as they stand in the world frame (z up).

    Depth, ids and normals are taken at pixel centres; colour is the mean of `samples` x `samples` rays per pixel.

    Args:
        parts: Meshes in the world frame [m]; a part without faces is allowed and never seen.
        camera: Intrinsics and size of the picture.
        camera_to_world: Pose of the camera, OpenCV axes.
        paints: One per part; by default every mesh wears its own vertex colours.
        lighting: Key light and sky; soft daylight by default.
        shadows: Whether a shadow ray is cast to the key light.
        sky_rays: Occlusion rays per sample that darken corners and contacts; 0 for none, 4 to 8 look good.
        samples: Side of the grid of samples in a pixel; 2 for pictures that people look at.

    Raises:
        ValueError: if `paints` is not as long as `parts`, or `samples` is not positive.
    """
    paints = [None] * len(parts) if paints is None else paints
    if len(paints) != len(parts):
        raise ValueError(f"{len(paints)} paints for {len(parts)} parts: give one each")
    if samples < 1:
        raise ValueError(f"samples is {samples}: give 1 or more")
    lighting = lighting or Lighting()
    scene = _Scene(parts, paints)
    linear = np.zeros((camera.height * camera.width, 3))
    for index in range(samples * samples):
        offset = ((index % samples + 0.5) / samples - 0.5, (index // samples + 0.5) / samples - 0.5)
        hits = scene.cast(camera, camera_to_world, offset)
        linear += scene.shade(hits, camera, camera_to_world.position, lighting, shadows, sky_rays, index, samples**2)
    color = np.rint(255.0 * np.clip(linear / samples**2, 0.0, 1.0) ** (1 / _GAMMA)).astype(np.uint8)
    center = scene.cast(camera, camera_to_world, (0.0, 0.0))
    shape = (camera.height, camera.width)
    depth, ids = np.zeros(linear.shape[0], dtype=np.float32), np.full(linear.shape[0], -1, dtype=np.int32)
    normals = np.zeros((linear.shape[0], 3), dtype=np.float32)
    depth[center.pixels], ids[center.pixels], normals[center.pixels] = center.depth, center.part, center.face_normals
    return Rendering(color.reshape(*shape, 3), depth.reshape(shape), ids.reshape(shape), normals.reshape(*shape, 3))


@dataclass(frozen=True, slots=True, eq=False)
class _Hits(Frozen):
    """Where the rays of one pass end, only those that hit, in pixel order."""

    pixels: np.ndarray
    depth: np.ndarray
    part: np.ndarray
    triangles: np.ndarray
    weights: np.ndarray
    points: np.ndarray
    face_normals: np.ndarray


class _Scene:
    """Meshes in one ray caster, with what shading needs per triangle."""

    def __init__(self, parts: Sequence[TriangleMesh], paints: Sequence[Paint]) -> None:
        self._caster = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._parts = parts
        self._paints = paints
        self._part_of: list[int] = []
        self._corner_normals: dict[int, Float32[np.ndarray, "m 3 3"]] = {}
        for index, mesh in enumerate(parts):
            if len(mesh.faces):
                vertices = o3d.core.Tensor.from_numpy(mesh.vertices.astype(np.float32))
                self._caster.add_triangles(vertices, o3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)))
                self._part_of.append(index)

    def cast(self, camera: Camera, camera_to_world: Pose, offset: tuple[float, float]) -> _Hits:
        """One ray per pixel, `offset` from its centre [px]."""
        v, u = np.indices((camera.height, camera.width), dtype=np.float64)
        x, y = (u + offset[0] - camera.cx) / camera.fx, (v + offset[1] - camera.cy) / camera.fy
        directions = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        directions = directions @ rotation_matrix(camera_to_world.quaternion_wxyz).T
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = camera_to_world.position, directions
        answer = self._caster.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=1)
        depth = answer["t_hit"].numpy()
        pixels = np.flatnonzero(np.isfinite(depth))
        depth, directions = depth[pixels], directions[pixels]
        part = np.array([*self._part_of, -1], dtype=np.int32)[answer["geometry_ids"].numpy()[pixels]]
        uv = answer["primitive_uvs"].numpy()[pixels]
        weights = np.stack([1.0 - uv.sum(axis=1), uv[:, 0], uv[:, 1]], axis=1)
        points = camera_to_world.position + directions * depth[:, None]
        normals = answer["primitive_normals"].numpy()[pixels]
        normals = np.where(_dot(normals, directions)[:, None] > 0.0, -normals, normals)
        return _Hits(pixels, depth, part, answer["primitive_ids"].numpy()[pixels], weights, points, normals)

    def shade(
        self,
        hits: _Hits,
        camera: Camera,
        eye: Vector3,
        lighting: Lighting,
        shadows: bool,
        sky_rays: int,
        index: int,
        passes: int,
    ) -> Float64[np.ndarray, "n 3"]:
        """Linear colour of every ray of pass `index`."""
        color = np.broadcast_to(_linear(np.array(lighting.background)), (camera.height * camera.width, 3)).copy()
        if not len(hits.pixels):
            return color
        normals, albedo = self._surface(hits)
        turn = _pixel_turns(hits.pixels, camera.width, index)
        radius = 0.0 if passes == 1 else lighting.key_radius * np.sqrt((index + 0.5) / passes)
        to_light = _around(np.array(lighting.key_direction), radius, turn)
        facing = np.maximum(_dot(normals, to_light), 0.0)
        if shadows:
            facing = facing * ~self._blocked(hits, to_light)
        up = (0.5 + 0.5 * normals[:, 2])[:, None]
        ambient = up * np.array(lighting.sky) + (1.0 - up) * np.array(lighting.ground)
        heights = (np.arange(sky_rays) * passes + index + 0.5) / max(sky_rays * passes, 1)
        ambient = ambient * self._openness(hits, normals, heights, turn)[:, None]
        half = _unit(_unit(eye - hits.points) + to_light)
        shine = lighting.gloss * np.maximum(_dot(normals, half), 0.0) ** 48 * (facing > 0.0)
        key = np.array(lighting.key)
        color[hits.pixels] = albedo * (ambient + facing[:, None] * key) + shine[:, None] * key
        return color

    def _surface(self, hits: _Hits) -> tuple[np.ndarray, Points]:
        """Smooth normals towards the eye and linear colours of the surfaces. Both of shape (n, 3)."""
        normals, albedo = np.empty_like(hits.face_normals), np.empty_like(hits.points)
        for index in self._part_of:
            here = np.flatnonzero(hits.part == index)
            if len(here):
                normals[here] = self._smooth_normals(index, hits.triangles[here], hits.weights[here])
                albedo[here] = self._albedo(index, hits.triangles[here], hits.weights[here], hits.points[here])
        return np.where(_dot(normals, hits.face_normals)[:, None] < 0.0, -normals, normals), albedo

    def _blocked(self, hits: _Hits, directions: Points) -> np.ndarray:
        # A tenth of a millimetre off the surface: thinner than any wall, thicker than float32's error at a metre.
        rays = np.empty((len(hits.points), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = hits.points + hits.face_normals * np.float32(1e-4), directions
        blocked: np.ndarray = self._caster.test_occlusions(o3d.core.Tensor.from_numpy(rays), nthreads=1).numpy()
        return blocked

    def _openness(self, hits: _Hits, normals: np.ndarray, heights: np.ndarray, turn: np.ndarray) -> np.ndarray:
        """The cosine-weighted share of the sky that each point sees, never below a quarter: light bounces."""
        if not len(heights):
            return np.ones(len(hits.points))
        seen, total = np.zeros(len(hits.points)), np.full(len(hits.points), 1e-9)
        for k, height in enumerate(heights):
            radius, angle = np.sqrt(1.0 - height * height), turn + k * _GOLDEN_ANGLE
            direction = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full_like(angle, height)], axis=1)
            weight = np.maximum(_dot(normals, direction), 0.0)
            seen += weight * ~self._blocked(hits, direction)
            total += weight
        openness: np.ndarray = np.where(total > 1e-6, 0.25 + 0.75 * seen / total, 0.6)
        return openness

    def _smooth_normals(self, index: int, triangles: np.ndarray, weights: np.ndarray) -> np.ndarray:
        if index not in self._corner_normals:
            self._corner_normals[index] = _corner_normals(self._parts[index]).astype(np.float32)
        return _unit(np.einsum("nk,nkd->nd", weights, self._corner_normals[index][triangles]))

    def _albedo(self, index: int, triangles: np.ndarray, weights: np.ndarray, points: Points) -> Points:
        mesh, paint = self._parts[index], self._paints[index]
        if callable(paint):
            return _linear(paint(points))
        if paint is None and mesh.vertex_colors is not None:
            corners = mesh.vertex_colors[mesh.faces[triangles]].astype(np.float64)
            return _linear(np.einsum("nk,nkd->nd", weights, corners))
        return np.broadcast_to(_linear(np.array(paint or _GREY)), points.shape)


def _corner_normals(mesh: TriangleMesh) -> Float64[np.ndarray, "m 3 3"]:
    """Unit normals of each face's corners: the mean over the faces at that position within the crease angle."""
    corners = mesh.vertices[mesh.faces]
    scaled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = _unit(scaled)
    _, welded = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)
    position: np.ndarray = welded.reshape(-1)[mesh.faces].reshape(-1)
    face = np.repeat(np.arange(len(mesh.faces)), 3)
    order = np.argsort(position, kind="stable")
    starts = np.flatnonzero(np.diff(position[order], prepend=-1))
    valence = np.diff(np.append(starts, len(order)))
    # Every pair of corners that share a position; a fan of hundreds of faces stays flat rather than cost its square.
    group = np.repeat(np.arange(len(starts)), valence)
    pairs = np.where(valence > _MAX_VALENCE, 1, valence)[group]
    first = np.repeat(np.arange(len(order)), pairs)
    within = np.arange(len(first)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    second = np.where(valence[group[first]] > _MAX_VALENCE, first, starts[group[first]] + within)
    here, there = order[first], order[second]
    agree = np.einsum("ij,ij->i", flat[face[here]], flat[face[there]]) > _CREASE_COS
    # A sliver's own normal is noise: it weighs by its area, like every face.
    weight = scaled[face[there]] * agree[:, None]
    total = np.stack([np.bincount(here, weight[:, k], minlength=len(face)) for k in range(3)], axis=1)
    fallback = np.linalg.norm(total, axis=1, keepdims=True) < 1e-18
    return _unit(np.where(fallback, flat[face], total)).reshape(-1, 3, 3)


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.sqrt(_dot(vectors, vectors))[..., None]
    unit: np.ndarray = vectors / np.where(length > 0.0, length, 1.0)
    return unit


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    product: np.ndarray = np.einsum("...i,...i->...", a, b)
    return product


def _linear(srgb: np.ndarray) -> np.ndarray:
    linear: np.ndarray = np.clip(srgb / 255.0, 0.0, 1.0) ** _GAMMA
    return linear


def _pixel_turns(pixels: np.ndarray, width: int, index: int) -> np.ndarray:
    """An angle per pixel that differs between neighbours, so that few rays give grain and not steps of shadow [rad].

    Interleaved gradient noise (Jimenez, 2014), turned by the golden angle from pass to pass.
    """
    v, u = np.divmod(pixels, width)
    turns: np.ndarray = (
        2 * np.pi * ((52.9829189 * ((0.06711056 * u + 0.00583715 * v) % 1.0)) % 1.0) + index * _GOLDEN_ANGLE
    )
    return turns


def _around(direction: Vector3, radius: float, turn: np.ndarray) -> Points:
    """Unit directions on a cone of `radius` [rad] about an axis, one per turn. Shape (n, 3)."""
    axis = _unit(direction)
    side = _unit(np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0]))
    across = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side)
    return _unit(axis + radius * across)
