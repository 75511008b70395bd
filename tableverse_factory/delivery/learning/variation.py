"""What a reset may change, each drawn from the seed: where objects stand, what the table looks like, the light."""

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from schemas.geometry import Vector3
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.geometry.math.transforms import multiply_quaternions, quaternion_about_z
from tableverse_factory.physics.mjcf.spec import TABLE
from tableverse_factory.physics.render.domain_randomization import LIGHT_ELEVATION_RAD, LIGHT_STRENGTH, LIGHT_WARMTH
from tableverse_factory.physics.render.render import Lighting
from tableverse_factory.robotics.robots.station import Station
from tableverse_factory.sources.textures.catalogue import COUNT

_TRIES = 20
_DEEPER_M = 2e-4
"""An object that is moved may touch nothing deeper than the table held it before."""


@dataclass(frozen=True, slots=True)
class Variation:
    """Nothing by default: every reset is the scene as it was exported.

    Attributes:
        position_m: Objects that touch the table alone are moved on it by up to this along x and y, each by its own
            draw; one for which no draw of twenty is free and leaves on the table all that it stands on stays [m].
        yaw_rad: And turned about the vertical by up to this [rad].
        table: Another table-top from the catalogue of textures; seen in pictures alone.
        lights: Another direction, strength and warmth of the light; seen in pictures alone.
    """

    position_m: float = 0.0
    yaw_rad: float = 0.0
    table: bool = False
    lights: bool = False

    def __post_init__(self) -> None:
        if not (0.0 <= self.position_m <= 1.0 and 0.0 <= self.yaw_rad <= np.pi):
            raise ConfigError(f"position_m {self.position_m}, yaw_rad {self.yaw_rad}: from 0 to 1 m and to pi")


def displaced(station: Station, data: mujoco.MjData, variation: Variation, rng: np.random.Generator) -> None:
    """Moves objects within data as `variation` allows; positions have to be computed anew afterwards.

    Places are tried in a copy: one that is taken may fill MuJoCo's memory with contacts, of which data keep a warning.

    Args:
        station: Whose data these are.
        data: Fresh, positions computed.
        variation: What is allowed.
        rng: Same state, same places.
    """
    if variation.position_m == 0.0 and variation.yaw_rad == 0.0:
        return
    tried = copy.copy(data)
    for name in _on_table_alone(station, tried):
        at, body = station.object_qpos[name], station.object_bodies[name]
        before, depth, center = tried.qpos[at : at + 7].copy(), _deepest(station, tried, body), tried.xipos[body].copy()
        standing = np.vstack([center, tried.contact.pos[_contacts(station, tried, body)]])
        offsets = rng.uniform(-variation.position_m, variation.position_m, (_TRIES, 2))
        turns = rng.uniform(-variation.yaw_rad, variation.yaw_rad, _TRIES)
        for offset, turn in zip(offsets, turns, strict=True):
            shift = np.array([*offset, 0.0])
            if not _above_table(station, tried, _turned(standing - center, turn) + center + shift):
                continue
            tried.qpos[at : at + 7] = _moved(before, center, shift, float(turn))
            if _touched(station, tried, body) == {_table(station)} and _deepest(station, tried, body) <= depth:
                break
            tried.qpos[at : at + 7] = before
        mujoco.mj_fwdPosition(station.model, tried)
    data.qpos[:] = tried.qpos


def _moved(pose: np.ndarray, center: Vector3, offset: Vector3, turn: float) -> np.ndarray:
    """A pose turned about the vertical through a centre, then moved. Shape (7,)."""
    position = center + _turned(pose[:3] - center, turn) + offset
    return np.concatenate([position, multiply_quaternions(quaternion_about_z(turn), pose[3:])])


def _turned(points: np.ndarray, turn: float) -> np.ndarray:
    """About the vertical. Shape of `points`, whose last axis is x, y, z."""
    c, s = np.cos(turn), np.sin(turn)
    turned: np.ndarray = points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return turned


def _above_table(station: Station, data: mujoco.MjData, points: np.ndarray) -> bool:
    """Whether points lie within the edges of the table-top: what only hangs over there topples. Shape (n, 3)."""
    slab = station.model.geom(TABLE).id
    along = (points - data.geom_xpos[slab]) @ data.geom_xmat[slab].reshape(3, 3)
    return bool((np.abs(along) <= station.model.geom_size[slab])[:, :2].all())


def _on_table_alone(station: Station, data: mujoco.MjData) -> list[str]:
    return [name for name, body in station.object_bodies.items() if _touched(station, data, body) == {_table(station)}]


def _table(station: Station) -> int:
    return int(mujoco.mj_name2id(station.model, mujoco.mjtObj.mjOBJ_BODY, TABLE))


def _touched(station: Station, data: mujoco.MjData, body: int) -> set[int]:
    """Bodies that a body touches as it stands now."""
    mujoco.mj_fwdPosition(station.model, data)
    pairs = station.model.geom_bodyid[data.contact.geom]
    return {int(other) for pair in pairs for other in pair if body in pair and other != body}


def _contacts(station: Station, data: mujoco.MjData, body: int) -> np.ndarray:
    """Which contacts are a body's. Shape (c,)."""
    mine: np.ndarray = (station.model.geom_bodyid[data.contact.geom] == body).any(axis=1)
    return mine


def _deepest(station: Station, data: mujoco.MjData, body: int) -> float:
    """How deep a body touches others, and `_DEEPER_M` more [m]."""
    return float(-data.contact.dist[_contacts(station, data, body)].min(initial=0.0)) + _DEEPER_M


def table_seed(rng: np.random.Generator) -> int:
    """Of the catalogue's textures."""
    return int(rng.integers(COUNT))


def lighting_of(rng: np.random.Generator) -> Lighting:
    """Daylight from elsewhere, stronger or weaker, warmer or colder."""
    azimuth, elevation = rng.uniform(0.0, 2 * np.pi), rng.uniform(*LIGHT_ELEVATION_RAD)
    warmth, plain = rng.uniform(-LIGHT_WARMTH, LIGHT_WARMTH), Lighting()
    red, green, blue = rng.uniform(*LIGHT_STRENGTH) * np.array(plain.key) * [1 + warmth, 1.0, 1 - warmth]
    c, s = np.cos(elevation), np.sin(elevation)
    direction = (float(c * np.cos(azimuth)), float(c * np.sin(azimuth)), float(s))
    return Lighting(key_direction=direction, key=(float(red), float(green), float(blue)))
