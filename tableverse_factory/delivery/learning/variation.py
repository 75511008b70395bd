"""Domain randomization of resets, drawn from the seed: object poses, table texture, light, cameras and friction."""

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from schemas.geometry import Vector3
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.delivery.episodes.cameras import CameraShift
from tableverse_factory.geometry.math.transforms import multiply_quaternions, quaternion_about_z
from tableverse_factory.physics.mjcf.spec import TABLE
from tableverse_factory.physics.render.domain_randomization import (
    CAMERA_SHIFT_M,
    CAMERA_TURN_RAD,
    CAMERA_ZOOM,
    LIGHT_ELEVATION_RAD,
    LIGHT_STRENGTH,
    LIGHT_WARMTH,
)
from tableverse_factory.physics.render.render import Lighting
from tableverse_factory.robotics.execution.perturbations import scale_friction
from tableverse_factory.robotics.robots.station import Station
from tableverse_factory.sources.textures.catalogue import TEXTURE_COUNT

_MAX_TRIES = 20
MAX_FRICTION = 10.0
_DEEPER_M = 2e-4  # allowed extra penetration of a moved object


@dataclass(frozen=True, slots=True)
class Variation:
    """Randomization of resets; none by default.

    Attributes:
        position_m: Objects that touch only the table move on it by up to this along x and y, each by its own draw; one
            without a free draw in twenty that keeps all its contacts on the table stays [m].
        yaw_rad: Their rotation about the vertical, up to this [rad].
        table: Draw a table texture from the catalog; visible in pictures only.
        lights: Draw direction, strength and warmth of the light; visible in pictures only.
        cameras: Draw a small displacement of every camera; visible in pictures only.
        friction: Sliding and torsional friction of X and the fingers get a factor from 1/friction to friction.
    """

    position_m: float = 0.0
    yaw_rad: float = 0.0
    table: bool = False
    lights: bool = False
    cameras: bool = False
    friction: float = 1.0

    def __post_init__(self) -> None:
        if not (0.0 <= self.position_m <= 1.0 and 0.0 <= self.yaw_rad <= np.pi):
            raise ConfigError(f"position_m {self.position_m}, yaw_rad {self.yaw_rad}: from 0 to 1 m and to pi")
        if not 1.0 <= self.friction <= MAX_FRICTION:
            raise ConfigError(f"friction {self.friction}: give a factor from 1 to {MAX_FRICTION:g}")


def displace_objects(station: Station, data: mujoco.MjData, variation: Variation, rng: np.random.Generator) -> None:
    """Move objects within fresh data as `variation` allows; positions must be recomputed afterwards.

    Poses are tried in a copy, as a blocked one may fill MuJoCo's memory with contacts, of which data keep a warning.
    """
    if variation.position_m == 0.0 and variation.yaw_rad == 0.0:
        return
    tried, bodies = copy.copy(data), station.object_bodies
    table = {int(mujoco.mj_name2id(station.model, mujoco.mjtObj.mjOBJ_BODY, TABLE))}
    free = [name for name in bodies if _find_touched_bodies(station, tried, bodies[name]) == table]
    for name in free:
        at, body = station.object_qpos[name], bodies[name]
        before, center = tried.qpos[at : at + 7].copy(), tried.xipos[body].copy()
        depth = _measure_depth(station, tried, body)
        standing = np.vstack([center, tried.contact.pos[_mask_contacts(station, tried, body)]])
        offsets = rng.uniform(-variation.position_m, variation.position_m, (_MAX_TRIES, 2))
        turns = rng.uniform(-variation.yaw_rad, variation.yaw_rad, _MAX_TRIES)
        for offset, turn in zip(offsets, turns, strict=True):
            shift = np.array([*offset, 0.0])
            if not _is_above_table(station, tried, _rotate_about_z(standing - center, turn) + center + shift):
                continue
            tried.qpos[at : at + 7] = _move_pose(before, center, shift, float(turn))
            touched = _find_touched_bodies(station, tried, body)
            if touched == table and _measure_depth(station, tried, body) <= depth:
                break
            tried.qpos[at : at + 7] = before
        mujoco.mj_fwdPosition(station.model, tried)
    data.qpos[:] = tried.qpos


def _move_pose(pose: np.ndarray, center: Vector3, offset: Vector3, turn: float) -> np.ndarray:
    """Rotate a pose about the vertical through a center, then move it. Shape (7,)."""
    position = center + _rotate_about_z(pose[:3] - center, turn) + offset
    return np.concatenate([position, multiply_quaternions(quaternion_about_z(turn), pose[3:])])


def _rotate_about_z(points: np.ndarray, turn: float) -> np.ndarray:
    """Rotate points, whose last axis is x, y, z."""
    c, s = np.cos(turn), np.sin(turn)
    return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _is_above_table(station: Station, data: mujoco.MjData, points: np.ndarray) -> bool:
    """Test whether points lie within the table's edges, as objects that overhang them topple. Shape (n, 3)."""
    slab = station.model.geom(TABLE).id
    along = (points - data.geom_xpos[slab]) @ data.geom_xmat[slab].reshape(3, 3)
    return bool((np.abs(along) <= station.model.geom_size[slab])[:, :2].all())


def _find_touched_bodies(station: Station, data: mujoco.MjData, body: int) -> set[int]:
    """Find bodies that a body touches after positions are recomputed."""
    mujoco.mj_fwdPosition(station.model, data)
    pairs = station.model.geom_bodyid[data.contact.geom]
    return {int(other) for pair in pairs for other in pair if body in pair and other != body}


def _mask_contacts(station: Station, data: mujoco.MjData, body: int) -> np.ndarray:
    """Mask a body's contacts. Shape (c,)."""
    return (station.model.geom_bodyid[data.contact.geom] == body).any(axis=1)


def _measure_depth(station: Station, data: mujoco.MjData, body: int) -> float:
    """Measure a body's deepest contact, plus `_DEEPER_M` [m]."""
    return float(-data.contact.dist[_mask_contacts(station, data, body)].min(initial=0.0)) + _DEEPER_M


def draw_table_seed(rng: np.random.Generator) -> int:
    """Draw the seed of a texture of the catalog."""
    return int(rng.integers(TEXTURE_COUNT))


def draw_lighting(rng: np.random.Generator) -> Lighting:
    """Draw daylight of random direction, strength and warmth."""
    azimuth, elevation = rng.uniform(0.0, 2 * np.pi), rng.uniform(*LIGHT_ELEVATION_RAD)
    warmth, plain = rng.uniform(-LIGHT_WARMTH, LIGHT_WARMTH), Lighting()
    red, green, blue = rng.uniform(*LIGHT_STRENGTH) * np.array(plain.key) * [1 + warmth, 1.0, 1 - warmth]
    c, s = np.cos(elevation), np.sin(elevation)
    direction = (float(c * np.cos(azimuth)), float(c * np.sin(azimuth)), float(s))
    return Lighting(key_direction=direction, key=(float(red), float(green), float(blue)))


def draw_camera_shift(rng: np.random.Generator) -> CameraShift:
    """Draw a displacement of cameras, within the bounds of `physics.render.domain_randomization`."""
    shift = rng.uniform(-CAMERA_SHIFT_M, CAMERA_SHIFT_M, 3)
    turn = rng.uniform(-CAMERA_TURN_RAD, CAMERA_TURN_RAD, 3)
    zoom = 1.0 + rng.uniform(-CAMERA_ZOOM, CAMERA_ZOOM)
    return CameraShift(tuple(shift.tolist()), tuple(turn.tolist()), float(zoom))


def vary_friction(station: Station, object_id: str, variation: Variation, rng: np.random.Generator) -> None:
    """Scale the friction of the carried object and the fingers by a factor drawn as `variation` allows."""
    if variation.friction != 1.0:
        factor = float(variation.friction ** rng.uniform(-1.0, 1.0))
        scale_friction(station, station.object_bodies[object_id], factor)
