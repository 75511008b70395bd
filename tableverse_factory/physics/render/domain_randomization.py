"""Domain randomization of a scene in memory: the table's texture, the lights and the camera.

Bodies, geoms, masses and contacts stay, so that the certificate stays valid.
"""

import posixpath
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.geometry.math.transforms import multiply_quaternions, normalize_quaternion
from tableverse_factory.physics.mjcf.load import parse_document
from tableverse_factory.physics.mjcf.portable_xml import find_or_add_child
from tableverse_factory.physics.mjcf.spec import ASSETS, TABLE

CAMERA = "observation"
CAMERA_SHIFT_M = 0.03  # most shift of the camera along each axis
CAMERA_TURN_RAD = float(np.deg2rad(2.0))  # and rotation about each
CAMERA_ZOOM = 0.04  # and change of the field of view in proportion
LIGHT_ELEVATION_RAD = (float(np.deg2rad(35.0)), float(np.deg2rad(80.0)))  # bounds over the table
LIGHT_STRENGTH = (0.55, 1.1)  # bounds of the relative strength
LIGHT_WARMTH = 0.12  # bound of how much more red and less blue
_OTHER_ORIENTATIONS = ("euler", "axisangle", "xyaxes", "zaxis", "target")


def randomize_appearance(
    files: Mapping[str, bytes],
    *,
    table_png: bytes | None = None,
    tile_m: float = 1.0,
    lights: int | None = None,
    camera: int | None = None,
) -> dict[str, bytes]:
    """Randomize the appearance of a scene; returns new files and leaves the given ones.

    `table_png` is repeated over the table every `tile_m` [m]; None keeps the present texture. `lights` is a seed for
    position, strength and warmth of every light, `camera` one for the pose of the camera `observation`, which is added
    where it is missing.

    Raises:
        InputError: `bad_mjcf` if `scene.xml` is absent or no MJCF, or has no table to change.
    """
    root = parse_document(files)
    randomized = dict(files)
    if table_png is not None:
        randomized[f"{ASSETS}/{TABLE}.png"] = table_png
        _cover_table(root, tile_m)
    if lights is not None:
        _relight(root, make_rng(lights, "staging", "lights"))
    if camera is not None:
        _move_camera(root, make_rng(camera, "staging", "camera"))
    ET.indent(root)
    randomized["scene.xml"] = (ET.tostring(root, encoding="unicode") + "\n").encode()
    return randomized


def _cover_table(root: ET.Element, tile_m: float) -> None:
    _, geom = _find_table(root)
    half = _read_numbers(geom, "size", 3)
    asset = find_or_add_child(root, "asset")
    for element in [e for e in asset if e.tag in ("texture", "material") and e.get("name") == TABLE]:
        asset.remove(element)
    compiler = find_or_add_child(root, "compiler")
    folder = compiler.get("texturedir", compiler.get("assetdir", "."))
    file = posixpath.relpath(f"{ASSETS}/{TABLE}.png", folder)
    ET.SubElement(asset, "texture", name=TABLE, type="2d", file=file)
    repeat = _text([2 * half[0] / tile_m, 2 * half[1] / tile_m])
    ET.SubElement(asset, "material", name=TABLE, texture=TABLE, texrepeat=repeat, specular="0.15", shininess="0.3")
    geom.attrib.pop("rgba", None)
    geom.set("material", TABLE)


def _relight(root: ET.Element, rng: np.random.Generator) -> None:
    head = find_or_add_child(find_or_add_child(root, "visual"), "headlight")
    for key, default in (("ambient", 0.1), ("diffuse", 0.4)):
        strength = rng.uniform(*LIGHT_STRENGTH)
        head.set(key, _text(strength * _read_numbers(head, key, 3, [default] * 3)))
    world = find_or_add_child(root, "worldbody")
    lamps = list(world.iter("light")) or [ET.SubElement(world, "light", pos="0 0 2", dir="0 0 -1")]
    for lamp in lamps:
        strength, warmth = rng.uniform(*LIGHT_STRENGTH), rng.uniform(-LIGHT_WARMTH, LIGHT_WARMTH)
        tint = strength * np.array([1 + warmth, 1.0, 1 - warmth])
        lamp.set("diffuse", _text(tint * _read_numbers(lamp, "diffuse", 3, [0.7] * 3)))
        _turn_lamp(lamp, rng.uniform(0.0, 2 * np.pi), rng.uniform(*LIGHT_ELEVATION_RAD))


def _turn_lamp(lamp: ET.Element, azimuth: float, elevation: float) -> None:
    """Turn a light about its target, at the same distance."""
    place = _read_numbers(lamp, "pos", 3, [0.0, 0.0, 0.0])
    direction = _read_numbers(lamp, "dir", 3, [0.0, 0.0, -1.0])
    if place[2] <= 0.0 or direction[2] >= 0.0:
        return  # it does not shine down on the table: only its colour changes
    target = place + direction * (place[2] / -direction[2])
    distance = np.linalg.norm(place - target)
    c, s = np.cos(elevation), np.sin(elevation)
    towards = np.array([c * np.cos(azimuth), c * np.sin(azimuth), s])
    lamp.set("pos", _text(target + distance * towards))
    lamp.set("dir", _text(-towards))


def _move_camera(root: ET.Element, rng: np.random.Generator) -> None:
    world = find_or_add_child(root, "worldbody")
    eye = next((c for c in world.findall("camera") if c.get("name") == CAMERA), None)
    if eye is None:
        _add_camera(root, world, rng)
        return
    shift, turn = rng.uniform(-CAMERA_SHIFT_M, CAMERA_SHIFT_M, 3), rng.uniform(-CAMERA_TURN_RAD, CAMERA_TURN_RAD, 3)
    zoom = 1 + rng.uniform(-CAMERA_ZOOM, CAMERA_ZOOM)
    eye.set("pos", _text(_read_numbers(eye, "pos", 3, [0.0] * 3) + shift))
    if not any(name in eye.attrib for name in _OTHER_ORIENTATIONS):
        before = _read_numbers(eye, "quat", 4, [1.0, 0.0, 0.0, 0.0])
        if not 1e-6 < np.abs(before).max() < 1e6:
            raise InputError(f"scene.xml: quat={eye.get('quat', '')[:60]!r} of a camera is no rotation", "bad_mjcf")
        small = normalize_quaternion(np.array([1.0, *(turn / 2)]))
        eye.set("quat", _text(multiply_quaternions(normalize_quaternion(before), small)))
    for key, count, factor in (("fovy", 1, zoom), ("focalpixel", 2, 1 / zoom)):
        if key in eye.attrib:
            eye.set(key, _text(factor * _read_numbers(eye, key, count)))


def _add_camera(root: ET.Element, world: ET.Element, rng: np.random.Generator) -> None:
    """Add a camera in front, raised, with the whole table in view."""
    body, geom = _find_table(root)
    center = _read_numbers(body, "pos", 3, [0.0] * 3)
    half_x, half_y, _ = _read_numbers(geom, "size", 3)
    distance = 2.2 * float(np.hypot(half_x, half_y))
    azimuth, elevation = rng.uniform(-0.4, 0.4), rng.uniform(0.6, 1.0)
    right = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    back = np.array([np.cos(elevation) * right[1], -np.cos(elevation) * right[0], np.sin(elevation)])
    place, axes = center + distance * back, _text([*right, *np.cross(back, right)])
    ET.SubElement(world, "camera", name=CAMERA, pos=_text(place), xyaxes=axes, fovy="40")


def _find_table(root: ET.Element) -> tuple[ET.Element, ET.Element]:
    for body in root.iter("body"):
        geom = next((g for g in body.findall("geom") if g.get("type") == "box"), None)
        if body.get("name") == TABLE and geom is not None:
            return body, geom
    raise InputError(f"scene.xml has no body {TABLE!r} with a box: there is no table to change", "bad_mjcf")


def _read_numbers(
    element: ET.Element, key: str, count: int, default: Sequence[float] = ()
) -> Float64[np.ndarray, " n"]:
    """Read the `count` numbers of an attribute, or the default where it is missing or empty."""
    text = element.get(key, "")
    try:
        values = np.array([float(word) for word in text.split()] or default, dtype=np.float64)
    except ValueError:
        values = np.full(0, np.nan)
    if len(values) != count or not np.isfinite(values).all():
        why = f"scene.xml: {key}={text[:60]!r} of <{element.tag}>: {count} finite numbers are wanted"
        raise InputError(why, "bad_mjcf")
    return values


def _text(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{float(value):.9g}" for value in values)
