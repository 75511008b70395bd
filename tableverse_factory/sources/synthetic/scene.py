"""Synthetic scene, from random numbers to images: arranged, settled, rendered, sensed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt16

from schemas.geometry import Camera, Frozen, IdImage, Picture, Points, Pose, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.transforms import invert_pose, transform_points
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.physics.render.raycast import Raycaster
from tableverse_factory.physics.render.render import Pattern, Rendering, render
from tableverse_factory.sources.synthetic import studio
from tableverse_factory.sources.synthetic.arrange import arrange_groups
from tableverse_factory.sources.synthetic.recipes import PlacedModel
from tableverse_factory.sources.synthetic.sensor import make_sensor, sense_color, sense_depth
from tableverse_factory.sources.synthetic.settle import MAX_PENETRATION_M, settle_arrangement

MIN_OBJECTS = 3
ATTEMPTS = 20
SUBSAMPLING = 2
"""Silhouettes are counted on every second pixel each way, over a view twice as wide and high as the picture."""


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticObject(Frozen):
    """An object at rest, the index of its container or None, its visible pixels, and their share of its silhouette."""

    placed: PlacedModel
    contained_in: int | None
    visible_pixels: int
    visible_fraction: float


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticScene(Frozen):
    """A table-top with its images and ground truth.

    Attributes:
        objects: In the order of their instance ids, which start at 1.
        depth: Shape (h, w), with a sensor's noise and holes; metres are `depth * depth_scale`, 0 is no reading.
        depth_scale: Metres per unit of depth.
        true_depth: Shape (h, w) float32 [m], without noise; 0 where nothing is.
        ids: Shape (h, w), index of the object at each pixel, -1 elsewhere.
        table_half_xy: Half extents of the table [m].
        table_pixels: Shape (h, w), where the table is seen.
        camera_to_table: Pose of the camera; the table frame has z up and its origin amid the table's upper face.
    """

    objects: tuple[SyntheticObject, ...]
    color: Picture
    depth: UInt16[np.ndarray, "h w"]
    depth_scale: float
    true_depth: np.ndarray
    ids: IdImage
    table_pixels: np.ndarray
    camera: Camera
    camera_to_table: Pose
    table_half_xy: tuple[float, float]


def make_scene(seed: int, scene_id: str) -> SyntheticScene:
    """Make a scene that depends on the two arguments alone."""
    rng = make_rng(seed, scene_id, "synth")
    placed, half_xy = arrange_scene(rng, scene_id)
    objects = [place_mesh(item.model.mesh, item.pose) for item in placed]
    azimuth = float(rng.integers(4)) * np.pi / 2 + float(rng.normal(0.0, 0.25))
    camera = studio.make_camera(rng)
    camera_to_table = studio.choose_viewpoint(rng, camera, azimuth, np.concatenate([mesh.vertices for mesh in objects]))
    rendering = _render_scene(rng, placed, objects, half_xy, azimuth, camera, camera_to_table)
    sensor = make_sensor(rng)
    shininess = np.array([*(item.model.shiny for item in placed), 0.0])
    ids = np.where(rendering.ids < len(objects), rendering.ids, -1)
    facing = _compute_facing(rendering, camera, camera_to_table)
    depth = sense_depth(rng, sensor, camera, rendering.depth, facing, shininess[ids])
    seen, fractions = _measure_visibility(ids, objects, camera, camera_to_table)
    holders = [find_container(index, placed) for index in range(len(placed))]
    return SyntheticScene(
        objects=tuple(
            SyntheticObject(item, holder, int(pixels), float(fraction))
            for item, holder, pixels, fraction in zip(placed, holders, seen, fractions, strict=True)
        ),
        color=sense_color(rng, rendering.color),
        depth=depth,
        depth_scale=sensor.depth_scale,
        true_depth=rendering.depth,
        ids=ids,
        table_pixels=rendering.ids == len(objects),
        camera=camera,
        camera_to_table=camera_to_table,
        table_half_xy=half_xy,
    )


def arrange_scene(rng: np.random.Generator, scene_id: str) -> tuple[list[PlacedModel], tuple[float, float]]:
    """Arrange objects at rest on a table, in its frame; returns them and the half extents of the table [m]."""
    half_xy = (float(rng.uniform(0.42, 0.75)), float(rng.uniform(0.38, 0.55)))
    for _ in range(ATTEMPTS):
        placed = arrange_groups(rng)
        rest = settle_arrangement(placed, half_xy)
        if not rest.at_rest or rest.penetration_m > MAX_PENETRATION_M or len(placed) - len(rest.fallen) < MIN_OBJECTS:
            continue
        poses = enumerate(zip(placed, rest.poses, strict=True))
        return [PlacedModel(item.model, pose) for index, (item, pose) in poses if index not in rest.fallen], half_xy
    raise GeometryError(f"synthetic scene {scene_id!r}: none of {ATTEMPTS} arrangements came to rest")


def _render_scene(
    rng: np.random.Generator,
    placed: Sequence[PlacedModel],
    objects: Sequence[TriangleMesh],
    half_xy: tuple[float, float],
    azimuth: float,
    camera: Camera,
    camera_to_table: Pose,
) -> Rendering:
    surfaces = [studio.make_table(rng, half_xy), *studio.make_room(rng, azimuth)]
    return render(
        [*objects, *(surface.mesh for surface in surfaces)],
        camera,
        camera_to_table,
        paints=[*(_transform_texture(item) for item in placed), *(surface.texture for surface in surfaces)],
        lighting=studio.make_lighting(rng),
        sky_rays=8,
        samples=2,
    )


def _transform_texture(item: PlacedModel) -> Pattern:
    table_to_object = invert_pose(item.pose)
    return lambda points: item.model.texture(transform_points(table_to_object, points))


def _compute_facing(rendering: Rendering, camera: Camera, camera_to_table: Pose) -> np.ndarray:
    """Compute the cosine between normal and line of sight at each pixel. Shape (h, w)."""
    rays = backproject(np.ones_like(rendering.depth), camera)
    rotation = Pose(np.zeros(3), invert_pose(camera_to_table).quaternion_wxyz)
    normals = transform_points(rotation, rendering.normals.reshape(-1, 3).astype(np.float64))
    facing: np.ndarray = np.abs(np.einsum("ij,ij->i", rays.reshape(-1, 3), normals)).reshape(rendering.depth.shape)
    facing /= np.linalg.norm(rays, axis=-1)
    return facing


def _measure_visibility(
    ids: IdImage, objects: Sequence[TriangleMesh], camera: Camera, camera_to_table: Pose
) -> tuple[np.ndarray, np.ndarray]:
    """Measure visible pixels of each object, and their share of its silhouette in 0–1. Both of shape (n,).

    What the edge of the picture cuts off counts as hidden.
    """
    fx, fy, cx, cy = (value / SUBSAMPLING for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    wide = Camera(fx, fy, cx + camera.width / 4, cy + camera.height / 4, camera.width, camera.height)
    _, parts = Raycaster(objects).covered(wide, camera_to_table)
    alone = np.bincount(parts, minlength=len(objects)) * float(SUBSAMPLING**2)
    seen = np.bincount(ids[(ids >= 0) & (ids < len(objects))], minlength=len(objects))
    return seen, np.clip(seen / np.maximum(alone, 1.0), 0.0, 1.0)


def find_container(index: int, placed: Sequence[PlacedModel]) -> int | None:
    """Find the container in whose cavity the lowest point of an object lies; None if there is none."""
    vertices = placed[index].vertices()
    lowest: Points = vertices[np.argmin(vertices[:, 2])][None]
    for other, holder in enumerate(placed):
        cavity = holder.model.cavity
        if other == index or cavity is None:
            continue
        x, y, z = transform_points(invert_pose(holder.pose), lowest)[0]
        wall = np.interp(z, [cavity.floor, cavity.rim], [cavity.floor_radius, cavity.rim_radius])
        if cavity.floor - 0.002 <= z <= cavity.rim - 0.004 and np.hypot(x, y) < wall + 0.006:
            return other
    return None
