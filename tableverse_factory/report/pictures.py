"""The pictures of one scene: its photograph, the twin from the same camera, a raised view and one from the top."""

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from schemas.geometry import Camera, Picture, Pose
from tableverse_factory.dataset import Scene
from tableverse_factory.errors import InputError
from tableverse_factory.geometry.transforms import normalized_quaternion
from tableverse_factory.physics.scenery import scenery_of_model
from tableverse_factory.physics.views import Eye, Quality, front_eye, photo_eye, pictures, top_eye

WIDTH = 640
THUMB_WIDTH = 320
ASPECT = 4 / 3
MAX_PHOTO_PIXELS = 100_000_000
QUALITY = Quality(samples=2, sky_rays=0)

_JPEG_QUALITY = 84
_AZIMUTH = float(np.deg2rad(28.0))


@dataclass(frozen=True, slots=True)
class PictureSet:
    """Which pictures a scene has, as file names without their ending; `-s` is appended for the thumbnail.

    Attributes:
        photo: The photograph; empty for a layout.
        twin: The twin from the photograph's camera; empty for a layout.
        front: The twin, raised, from the camera's side.
        top: The twin from the top.
        width: Of the large pictures [px].
        photo_height: Of photograph and twin [px].
        height: Of the other views [px].
    """

    photo: str
    twin: str
    front: str
    top: str
    width: int
    photo_height: int
    height: int


def write_pictures(scene: Scene, folder: Path) -> PictureSet:
    """Renders the scene and writes every picture as JPEG, large and small.

    Raises:
        InputError: if the scene's files do not load.
    """
    scenery = scenery_of_model(scene.model())
    if not scenery.names:
        raise InputError(f"scene {scene.scene_id} has no visual meshes")
    height = round(WIDTH / ASPECT)
    eyes = [front_eye(scenery, WIDTH, height, _AZIMUTH), top_eye(scenery, WIDTH, height)]
    photo, from_photo = _photograph(scene), _photo_eye(scene.meta)
    if from_photo is not None:
        eyes.append(from_photo)
    views = pictures(scenery, eyes, QUALITY)
    names = {"front": views[0].color, "top": views[1].color}
    if from_photo is not None:
        names["twin"] = views[2].color
    if photo is not None:
        names["photo"] = photo
    for name, picture in names.items():
        _save(picture, folder / f"{scene.scene_id}-{name}")
    photo_height = names.get("photo", names.get("twin", views[0].color)).shape[0]
    present = {name: f"{scene.scene_id}-{name}" if name in names else "" for name in ("photo", "twin", "front", "top")}
    return PictureSet(**present, width=WIDTH, photo_height=photo_height, height=height)


def _photograph(scene: Scene) -> Picture | None:
    data = scene.files().get("observation/color.jpg")
    if data is None:
        return None
    try:
        with Image.open(io.BytesIO(data)) as image:
            if image.width * image.height > MAX_PHOTO_PIXELS:
                raise InputError(f"scene {scene.scene_id}: its photograph has {image.width} × {image.height} pixels")
            height = max(1, round(image.height * WIDTH / image.width))
            return np.asarray(image.convert("RGB").resize((WIDTH, height), Image.Resampling.LANCZOS))
    except (OSError, ValueError) as error:
        raise InputError(f"scene {scene.scene_id}: its photograph does not decode: {error}"[:300]) from error


def _photo_eye(meta: dict[str, Any]) -> Eye | None:
    camera, pose = meta.get("camera"), meta.get("camera_to_table")
    if camera is None or pose is None:
        return None
    try:
        fx, fy, cx, cy = (float(camera[key]) for key in ("fx", "fy", "cx", "cy"))
        lens = Camera(fx, fy, cx, cy, *_size(camera))
        position, quaternion = (np.array(pose[key], dtype=np.float64) for key in ("position", "quaternion_wxyz"))
        return photo_eye(lens, Pose(position, normalized_quaternion(quaternion)), WIDTH)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"meta.json: its camera makes no sense: {json.dumps(camera)[:200]}: {error}"[:400]) from error


def _size(camera: dict[str, Any]) -> tuple[int, int]:
    width, height = int(camera["width"]), int(camera["height"])
    if not (0 < width <= 100_000 and 0 < height <= 100_000 and height <= 20 * width):
        raise ValueError(f"{width} × {height} pixels")
    return width, height


def _save(picture: Picture, stem: Path) -> None:
    image = Image.fromarray(np.ascontiguousarray(picture))
    image.save(stem.with_name(stem.name + ".jpg"), "JPEG", quality=_JPEG_QUALITY, optimize=True)
    small = image.resize(
        (THUMB_WIDTH, max(1, round(image.height * THUMB_WIDTH / image.width))), Image.Resampling.LANCZOS
    )
    small.save(stem.with_name(stem.name + "-s.jpg"), "JPEG", quality=_JPEG_QUALITY - 6, optimize=True)
