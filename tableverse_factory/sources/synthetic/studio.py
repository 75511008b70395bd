"""Surroundings of a synthetic scene: table, floor, wall, light and viewpoint."""

from dataclasses import dataclass

import numpy as np

from schemas.geometry import Camera, Frozen, Points, Pose, TriangleMesh
from tableverse_factory.geometry.math.camera import project
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose, quaternion_about_z, transform_points
from tableverse_factory.physics.render.render import Lighting, Pattern, look_at
from tableverse_factory.sources.synthetic.colors import pick_color
from tableverse_factory.sources.synthetic.settle import TABLE_THICKNESS_M
from tableverse_factory.sources.synthetic.solids import make_block
from tableverse_factory.sources.synthetic.textures import fill_color, tile_picture
from tableverse_factory.sources.textures.catalogue import (
    MEMBERS,
    TEXTURE_COUNT,
    TILE_M,
    make_texture,
    parse_texture_seed,
)

FLOOR_M = -0.74
TILE_PX = 512
FLOORS = ("planks", "herringbone_parquet", "laminate", "linen", "felt", "stone_slabs", "square_tiles", "concrete")
FLOOR_TILE_M = 1.5
WIDTH, HEIGHT = 640, 480
MARGIN_PX = 14
NEAREST_M, FARTHEST_M = 0.6, 1.3
LOWEST_RAD, HIGHEST_RAD = np.deg2rad(25.0), np.deg2rad(60.0)


@dataclass(frozen=True, slots=True, eq=False)
class StudioSurface(Frozen):
    """A surface of the surroundings in the table frame, and its colours by position."""

    mesh: TriangleMesh
    texture: Pattern


def make_table(rng: np.random.Generator, half_xy: tuple[float, float]) -> StudioSurface:
    """Make a slab with its upper face at z = 0, under one of the catalogue's textures."""
    size = (2 * half_xy[0], 2 * half_xy[1], TABLE_THICKNESS_M)
    slab = make_block(size, 0.02 if rng.random() < 0.5 else 0.0).translate((0.0, 0.0, -TABLE_THICKNESS_M))
    return StudioSurface(slab.to_mesh(), tile_picture(make_texture(int(rng.integers(TEXTURE_COUNT)), TILE_PX), TILE_M))


def make_room(rng: np.random.Generator, view_azimuth: float) -> list[StudioSurface]:
    """Make the floor, and often a wall behind the table as the camera sees it."""
    family = FLOORS[int(rng.integers(len(FLOORS)))]
    ground = parse_texture_seed(f"{family}-{int(rng.integers(MEMBERS))}")
    floor = _make_quad(np.array([[x, y, FLOOR_M] for x, y in ((-3.0, -3.0), (3.0, -3.0), (3.0, 3.0), (-3.0, 3.0))]))
    surfaces = [StudioSurface(floor, tile_picture(make_texture(ground, TILE_PX), FLOOR_TILE_M))]
    if rng.random() < 0.65:
        away = np.array([np.cos(view_azimuth), np.sin(view_azimuth), 0.0])
        side = np.array([-away[1], away[0], 0.0])
        foot = away * rng.uniform(1.0, 2.2) + [0.0, 0.0, FLOOR_M]
        tall = np.array([0.0, 0.0, 2.6])
        corners = np.array([foot + 3 * side, foot - 3 * side, foot - 3 * side + tall, foot + 3 * side + tall])
        _, color = pick_color(rng, ("white", "cream", "beige", "grey", "light blue", "olive"))
        grey = color.mean()
        surfaces.append(StudioSurface(_make_quad(corners), fill_color(grey + 0.7 * (color - grey))))
    return surfaces


def make_lighting(rng: np.random.Generator) -> Lighting:
    """Draw a light from above, warm or cool, and ambient light."""
    azimuth, height = rng.uniform(0.0, 2 * np.pi), rng.uniform(0.6, 1.35)
    direction = (np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height))
    warmth, exposure, key_share = rng.normal(0.0, 0.05), rng.uniform(0.85, 1.12), rng.uniform(0.42, 0.68)
    key = np.array([1.0 + warmth, 1.0, 1.0 - warmth]) * exposure * key_share * 1.05
    sky = np.array([1.0 - 0.5 * warmth, 1.0, 1.0 + 0.5 * warmth]) * exposure * (1.0 - key_share)
    return Lighting(
        key_direction=(float(direction[0]), float(direction[1]), float(direction[2])),
        key=(float(key[0]), float(key[1]), float(key[2])),
        key_radius=float(rng.uniform(0.03, 0.16)),
        sky=(float(sky[0]), float(sky[1]), float(sky[2])),
        ground=(float(0.5 * sky[0]), float(0.48 * sky[1]), float(0.45 * sky[2])),
        gloss=float(rng.uniform(0.03, 0.14)),
        background=(200.0, 204.0, 210.0),
    )


def make_camera(rng: np.random.Generator) -> Camera:
    """Draw a 640 x 480 camera of about 600 px focal length, its axis a few pixels off the middle."""
    focal = float(rng.normal(600.0, 8.0))
    cx, cy = (WIDTH - 1) / 2 + float(rng.normal(0.0, 4.0)), (HEIGHT - 1) / 2 + float(rng.normal(0.0, 4.0))
    return Camera(focal, focal, cx, cy, WIDTH, HEIGHT)


def choose_viewpoint(rng: np.random.Generator, camera: Camera, azimuth: float, points: Points) -> Pose:
    """Choose camera to table: 25–60° above it, 0.6–1.3 m away, as near as shows all points, shape (n, 3).

    The camera looks along `azimuth` over the table [rad].
    """
    elevation = rng.uniform(LOWEST_RAD, HIGHEST_RAD)
    back = np.array([-np.cos(elevation) * np.cos(azimuth), -np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    target = middle * [1.0, 1.0, 0.6] + np.append(rng.normal(0.0, 0.012, 2), 0.0)
    roll = Pose(np.zeros(3), quaternion_about_z(float(rng.normal(0.0, 0.02))))
    slack = rng.uniform(1.0, 1.25)
    for distance in np.arange(NEAREST_M, FARTHEST_M, 0.03):
        pose = compose_poses(look_at(target + back * distance, target), roll)
        if _is_in_view(camera, pose, points):
            break
    distance = min(distance * slack, FARTHEST_M)
    return compose_poses(look_at(target + back * distance, target), roll)


def _is_in_view(camera: Camera, camera_to_table: Pose, points: Points) -> bool:
    pixels = project(transform_points(invert_pose(camera_to_table), points), camera)
    inside = (pixels > MARGIN_PX) & (pixels < np.array([camera.width, camera.height]) - MARGIN_PX)
    return bool(inside.all())


def _make_quad(corners: Points) -> TriangleMesh:
    return TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))
