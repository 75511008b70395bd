"""The pictures of one scene: its photograph, and renders of its twin, before it was put right and after."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from schemas.geometry import Camera, Picture, Points, Pose
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.dataset.meta_poses import pose_in_meta
from tableverse_factory.dataset.preview_image import PHOTOGRAPH, TALLEST, read_photograph
from tableverse_factory.geometry.math.transforms import compose, inverse, transform_points
from tableverse_factory.physics.mjcf.drawables import Scenery, scenery_of_model
from tableverse_factory.physics.render.preview import Sketcher
from tableverse_factory.physics.render.views import Eye, Quality, front_eye, photo_eye, pictures, top_eye

WIDTH = 640
THUMB_WIDTH = 320
HEIGHT, THUMB_HEIGHT = 480, 240
QUALITY = Quality(samples=2, sky_rays=0)

_JPEG_QUALITY = 84
_AZIMUTH = float(np.deg2rad(28.0))


@dataclass(frozen=True, slots=True)
class PictureSet:
    """Which pictures a scene has, as file names without their ending; empty where there is none.

    Attributes:
        photo: The photograph.
        twin: The twin from the photograph's camera.
        before: Raised view of the layout as the picture, or the layout's file, had it.
        front: The same view of the scene as it was exported.
        top: From the top.
        sketch: A small and quick picture, where there is neither photograph nor render.
        photo_height: Of photograph and twin [px], `WIDTH` wide.
    """

    photo: str = ""
    twin: str = ""
    before: str = ""
    front: str = ""
    top: str = ""
    sketch: str = ""
    photo_height: int = HEIGHT

    @property
    def width(self) -> int:
        """Of every large picture [px]."""
        return WIDTH

    @property
    def height(self) -> int:
        """Of the other views [px], `WIDTH` wide."""
        return HEIGHT

    @property
    def thumbs(self) -> tuple[tuple[str, str], ...]:
        """The small pictures of its card with what they are, the one that says most first."""
        for names in (("photo", "twin"), ("front", "top"), ("sketch",)):
            shown = tuple((getattr(self, name), _CAPTIONS[name]) for name in names if getattr(self, name))
            if shown:
                return shown
        return ()


_CAPTIONS = {"photo": "photograph", "twin": "twin", "front": "front", "top": "top", "sketch": "sketch"}


def write_pictures(scene: Scene, folder: Path, render: bool) -> PictureSet:
    """Writes the pictures of a scene as JPEG, large and small.

    Args:
        scene: Opened.
        folder: For the files.
        render: Whether the twin is drawn, from every side. Otherwise there is only the photograph, or a sketch.

    Raises:
        InputError: if the scene's files do not load.
    """
    photo = _photograph(scene)
    drawn: dict[str, Picture] = {} if photo is None else {"photo": photo}
    if render:
        drawn |= _renders(scene)
    names = {name: f"{scene.scene_id}-{name}" for name in drawn}
    for name, picture in drawn.items():
        _save(picture, folder / names[name], thumb=name != "before")
    if not drawn:
        names["sketch"] = f"{scene.scene_id}-sketch"
        _save_small(Image.fromarray(_sketch(scene)), folder / names["sketch"])
    seen = drawn.get("photo", drawn.get("twin"))
    return PictureSet(**names, photo_height=HEIGHT if seen is None else seen.shape[0])


def _renders(scene: Scene) -> dict[str, Picture]:
    scenery = _scenery(scene)
    eyes = {"front": front_eye(scenery, WIDTH, HEIGHT, _AZIMUTH), "top": top_eye(scenery, WIDTH, HEIGHT)}
    from_photo = _photo_eye(scene.meta)
    if from_photo is not None:
        eyes["twin"] = from_photo
    views = pictures(scenery, list(eyes.values()), QUALITY)
    drawn = {name: view.color for name, view in zip(eyes, views, strict=True)}
    before = _before(scenery, scene.meta)
    if before is not None:
        drawn["before"] = pictures(before, [eyes["front"]], QUALITY)[0].color
    return drawn


def _sketch(scene: Scene) -> Picture:
    scenery = _scenery(scene)
    eye = front_eye(scenery, THUMB_WIDTH, THUMB_HEIGHT, _AZIMUTH)
    return Sketcher(scenery.parts, scenery.colors).draw(eye.camera, eye.camera_to_table)[0]


def _scenery(scene: Scene) -> Scenery:
    scenery = scenery_of_model(scene.model())
    if not scenery.names:
        raise InputError(f"scene {scene.scene_id} has no visual meshes")
    return scenery


def _before(scenery: Scenery, meta: Mapping[str, Any]) -> Scenery | None:
    """Every object where the picture put it, without those that it did not; None where meta.json does not say."""
    moves: dict[str, Pose] = {}
    unseen = set()
    for item in meta.get("objects", []):
        poses, name = item.get("poses"), str(item["object_id"])
        if not isinstance(poses, dict) or not {"placed", "settled"} <= poses.keys():
            return None
        if poses["placed"] is None:  # one of several alike, counted and not seen by itself
            unseen.add(name)
            continue
        placed, settled = (pose_in_meta(poses[key], name) for key in ("placed", "settled"))
        moves[name] = compose(placed, inverse(settled))
    names = (*scenery.names, *[""] * (len(scenery.parts) - len(scenery.names)))  # the table has none
    shown = [
        (replace(part, vertices=_moved(part.vertices, moves.get(name))), color)
        for name, part, color in zip(names, scenery.parts, scenery.colors, strict=True)
        if name not in unseen
    ]
    parts, colors = zip(*shown, strict=True)
    return Scenery(tuple(name for name in scenery.names if name not in unseen), parts, colors)


def _moved(vertices: Points, move: Pose | None) -> Points:
    return vertices if move is None else transform_points(move, vertices)


def _photograph(scene: Scene) -> Picture | None:
    data = scene.files().get(PHOTOGRAPH)
    if data is None:
        return None
    photo = read_photograph(data, f"scene {scene.scene_id}: its photograph", WIDTH)
    if photo.width < WIDTH:  # it lies over the twin, which is drawn at this width
        photo = photo.resize((WIDTH, round(photo.height * WIDTH / photo.width)), Image.Resampling.LANCZOS)
    return np.asarray(photo)


def _photo_eye(meta: Mapping[str, Any]) -> Eye | None:
    camera, pose = meta.get("camera"), meta.get("camera_to_table")
    if camera is None or pose is None:
        return None
    try:
        fx, fy, cx, cy = (float(camera[key]) for key in ("fx", "fy", "cx", "cy"))
        return photo_eye(Camera(fx, fy, cx, cy, *_size(camera)), pose_in_meta(pose, "the camera"), WIDTH)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"meta.json: its camera makes no sense: {json.dumps(camera)[:200]}: {error}"[:400]) from error


def _size(camera: Mapping[str, Any]) -> tuple[int, int]:
    width, height = int(camera["width"]), int(camera["height"])
    if not (0 < width <= 100_000 and 0 < height <= 100_000 and height <= TALLEST * width):
        raise ValueError(f"{width} × {height} pixels")
    return width, height


def _save(picture: Picture, stem: Path, thumb: bool) -> None:
    image = Image.fromarray(np.ascontiguousarray(picture))
    image.save(stem.with_name(stem.name + ".jpg"), "JPEG", quality=_JPEG_QUALITY, optimize=True)
    if thumb:
        _save_small(image, stem)


def _save_small(image: Image.Image, stem: Path) -> None:
    size = (THUMB_WIDTH, max(1, round(image.height * THUMB_WIDTH / image.width)))
    small = image if image.size == size else image.resize(size, Image.Resampling.BOX, reducing_gap=2.0)
    small.save(stem.with_name(stem.name + "-s.jpg"), "JPEG", quality=_JPEG_QUALITY - 6, optimize=True)
