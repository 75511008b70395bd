"""The twin from the camera of its photograph, and pictures of both side by side."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from PIL import Image

from schemas.config import ObserveConfig
from schemas.geometry import Camera, Frozen, IdImage, Picture
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import decode_image, open_image
from tableverse_factory.dataset.scene_meta import read_meta_camera
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.physics.mjcf.load import load_model
from tableverse_factory.physics.mjcf.scenery import load_scenery
from tableverse_factory.physics.render.render import Lighting, render

MASKS = "observation/masks.png"  # its name among the files of a scene
# Textures hold the light of the photograph: lamps would count twice.
EVEN_LIGHT = Lighting(key=(0.0, 0.0, 0.0), sky=(1.0, 1.0, 1.0), ground=(1.0, 1.0, 1.0), gloss=0.0)
MISSING, SURPLUS, OTHER = (214, 40, 57), (35, 105, 230), (240, 160, 20)  # see `draw_difference`
FADED = 0.55  # opacity of these colours over the photograph
WIDTH = 640  # of each of the three pictures [px]
GUTTER = 6  # white between two of them [px]


@dataclass(frozen=True, slots=True, eq=False)
class TwinView(Frozen):
    """An exported scene from the camera of its photograph.

    Attributes:
        names: Id in `ids` of each object, seen or not: its value in the masks; for a copy, one above all of them.
        depth: Distance along the optical axis [m]; 0 where nothing is.
        ids: 0 where no object is seen.
    """

    eye: PosedCamera
    names: Mapping[int, str]
    color: Picture
    depth: Float32[np.ndarray, "h w"]
    ids: IdImage


def render_twin(files: Mapping[str, bytes], meta: Mapping[str, Any], where: str) -> TwinView:
    """Render a scene from the camera of its photograph, in even light."""
    eye, scenery = read_meta_camera(meta), load_scenery(load_model(files))
    if eye is None:
        raise InputError(f"{where}: no camera of a photograph in meta.json", "bad_meta")
    values = _number_objects(meta, where)
    lacking = sorted({*scenery.names} ^ {*values})
    if lacking:
        raise InputError(f"{where}: meta.json and scene.xml disagree on {', '.join(lacking[:5])}", "bad_meta")
    drawn = render(
        scenery.parts, eye.camera, eye.camera_to_table, paints=scenery.colors, lighting=EVEN_LIGHT, shadows=False
    )
    by_part = np.array([*(values[name] for name in scenery.names), *[0] * (len(scenery.parts) - len(scenery.names)), 0])
    names = {value: name for name, value in values.items()}
    return TwinView(eye, names, drawn.color, drawn.depth, by_part[drawn.ids].astype(np.int32))


def decode_masks(files: Mapping[str, bytes], camera: Camera, bounds: ObserveConfig) -> IdImage:
    """Decode the instance ids that perception found."""
    image = open_image(files[MASKS], MASKS, bounds, "bad_masks")
    if image.size != (camera.width, camera.height):
        raise InputError(f"{MASKS} is {image.size}, the camera's picture {(camera.width, camera.height)}", "bad_masks")
    return decode_image(image, MASKS, None, "bad_masks").astype(np.int32)


def write_side_by_side(file: Path, photograph: Picture, twin: Picture, things: IdImage, shown: IdImage) -> None:
    """Write photograph, twin and their difference beside each other, as a PNG or JPEG file."""
    panels = [_scale(panel) for panel in (photograph, twin, draw_difference(photograph, things, shown))]
    gutter = np.full((panels[0].shape[0], GUTTER, 3), 255, dtype=np.uint8)
    row = np.concatenate([panels[0], gutter, panels[1], gutter, panels[2]], axis=1)
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(row).save(file, quality=88)


def draw_difference(photograph: Picture, things: IdImage, shown: IdImage) -> Picture:
    """Draw over the greyed photograph: red things without twin, blue twins without a thing, orange other things."""
    grey = np.repeat(photograph.mean(axis=2, keepdims=True), 3, axis=2)
    areas = (
        ((things > 0) & (shown == 0), MISSING),
        ((things == 0) & (shown > 0), SURPLUS),
        ((things > 0) & (shown > 0) & (things != shown), OTHER),
    )
    for where, color in areas:
        grey[where] = (1.0 - FADED) * grey[where] + FADED * np.array(color)
    return grey.astype(np.uint8)


def _scale(picture: Picture) -> Picture:
    height = max(1, round(picture.shape[0] * WIDTH / picture.shape[1]))
    image = Image.fromarray(np.array(picture))
    return np.asarray(image if image.width == WIDTH else image.resize((WIDTH, height), Image.Resampling.LANCZOS))


def _number_objects(meta: Mapping[str, Any], where: str) -> dict[str, int]:
    """Number each object with its value in the masks; copies, which have none of their own, above all of them."""
    entries = meta["objects"]
    values = [entry.get("mask_value") for entry in entries]
    if not all(isinstance(value, int) and 0 < value < 2**16 for value in values):
        raise InputError(f"{where}: meta.json has objects without a mask: {values!r:.100}", "bad_meta")
    numbers, above = {}, max(values, default=0)
    for entry, value in zip(entries, values, strict=True):
        above += bool(entry.get("copy_of"))
        numbers[str(entry["object_id"])] = above if entry.get("copy_of") else value
    return numbers
