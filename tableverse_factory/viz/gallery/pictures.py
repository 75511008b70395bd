"""Pictures of one scene: the photograph, and renders of the twin before rectification and after export."""

import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from PIL import Image

from schemas.geometry import Picture, Pose
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.dataset.preview_image import PHOTOGRAPH, read_photograph
from tableverse_factory.dataset.scene_meta import read_meta_camera, read_meta_pose
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose, transform_points
from tableverse_factory.physics.mjcf.scenery import Scenery, load_scenery
from tableverse_factory.physics.render.preview import PreviewRenderer
from tableverse_factory.physics.render.views import (
    RenderQuality,
    make_front_camera,
    make_top_camera,
    render_pictures,
    resize_camera,
)

WIDTH = 640
THUMB_WIDTH = 320
HEIGHT, THUMB_HEIGHT = 480, 240
QUALITY = RenderQuality(samples=2, sky_rays=0)

_JPEG_QUALITY = 84
_AZIMUTH = float(np.deg2rad(28.0))
_CAPTIONS = {"photo": "photograph"}  # of the others, their names


@dataclass(frozen=True, slots=True)
class PictureSet:
    """File names of the pictures of a scene without suffix; empty for those that do not exist."""

    photo: str = ""
    twin: str = ""  # the twin from the camera of the photograph
    before: str = ""  # view from above the front of the observed layout
    front: str = ""  # the same view of the exported scene
    top: str = ""
    sketch: str = ""  # a small and quick picture, without photograph and render
    photo_height: int = HEIGHT  # of photograph and twin, `WIDTH` wide [px]
    width: ClassVar[int] = WIDTH  # of every large picture [px]
    height: ClassVar[int] = HEIGHT  # of the other views [px]

    @property
    def thumbs(self) -> tuple[tuple[str, str], ...]:
        """The small pictures of the card with their captions, the most informative first."""
        for names in (("photo", "twin"), ("front", "top"), ("sketch",)):
            shown = tuple((getattr(self, name), _CAPTIONS.get(name, name)) for name in names if getattr(self, name))
            if shown:
                return shown
        return ()

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files."""
        large = [name for name in (self.photo, self.twin, self.before, self.front, self.top) if name]
        small = [name for name in (self.photo, self.twin, self.front, self.top, self.sketch) if name]
        return (*(f"{name}.jpg" for name in large), *(f"{name}-s.jpg" for name in small))


def name_pictures(scene_id: str, kinds: Iterable[str]) -> dict[str, str]:
    """Name pictures of a scene, without suffix, for the fields of its `PictureSet`."""
    return {kind: f"{scene_id}-{kind}" for kind in kinds}


def list_possible_pictures(scene_id: str, render: bool) -> tuple[str, ...]:
    """List the files of all pictures that a scene may have."""
    rendered = ("twin", "before", "front", "top") if render else ()
    return PictureSet(**name_pictures(scene_id, ("photo", "sketch", *rendered)), photo_height=HEIGHT).files


def write_pictures(scene: Scene, folder: Path, render: bool) -> PictureSet:
    """Write the pictures of a scene as JPEG, large and small; without `render` only the photograph or a sketch."""
    photo = _load_photograph(scene)
    drawn: dict[str, Picture] = {} if photo is None else {"photo": photo}
    if render:
        drawn |= _render_views(scene)
    names = name_pictures(scene.scene_id, drawn)
    for name, picture in drawn.items():
        _save(picture, folder / names[name], thumb=name != "before")
    if not drawn:
        names = name_pictures(scene.scene_id, ["sketch"])
        _save_small(Image.fromarray(_draw_sketch(scene)), folder / names["sketch"])
    seen = drawn.get("photo", drawn.get("twin"))
    return PictureSet(**names, photo_height=HEIGHT if seen is None else seen.shape[0])


def _render_views(scene: Scene) -> dict[str, Picture]:
    scenery = _load_scenery(scene)
    cameras = {
        "front": make_front_camera(scenery, WIDTH, HEIGHT, _AZIMUTH),
        "top": make_top_camera(scenery, WIDTH, HEIGHT),
    }
    eye = read_meta_camera(scene.meta)
    if eye is not None:
        cameras["twin"] = replace(eye, camera=resize_camera(eye.camera, WIDTH))
    views = render_pictures(scenery, list(cameras.values()), QUALITY)
    drawn = {name: view.color for name, view in zip(cameras, views, strict=True)}
    before = _build_before(scenery, scene.meta)
    if before is not None:
        drawn["before"] = render_pictures(before, [cameras["front"]], QUALITY)[0].color
    return drawn


def _draw_sketch(scene: Scene) -> Picture:
    scenery = _load_scenery(scene)
    camera = make_front_camera(scenery, THUMB_WIDTH, THUMB_HEIGHT, _AZIMUTH)
    return PreviewRenderer(scenery.parts, scenery.colors).draw(camera.camera, camera.camera_to_table)[0]


def _load_scenery(scene: Scene) -> Scenery:
    scenery = load_scenery(scene.model())
    if not scenery.names:
        raise InputError(f"scene {scene.scene_id} has no visual meshes")
    return scenery


def _build_before(scenery: Scenery, meta: Mapping[str, Any]) -> Scenery | None:
    """Move every object to its observed pose and leave out those without one; None if meta.json lacks the poses."""
    moves: dict[str, Pose] = {}
    unseen = set()
    for item in meta.get("objects", []):
        poses, name = item.get("poses"), str(item["object_id"])
        if not isinstance(poses, dict) or not {"placed", "settled"} <= poses.keys():
            return None
        if poses["placed"] is None:  # a copy that was counted, not observed
            unseen.add(name)
            continue
        placed, settled = (read_meta_pose(poses[key], name) for key in ("placed", "settled"))
        moves[name] = compose_poses(placed, invert_pose(settled))
    names = (*scenery.names, *[""] * (len(scenery.parts) - len(scenery.names)))  # the table has no name
    shown = [
        (replace(part, vertices=transform_points(moves[name], part.vertices)) if name in moves else part, color)
        for name, part, color in zip(names, scenery.parts, scenery.colors, strict=True)
        if name not in unseen
    ]
    parts, colors = zip(*shown, strict=True)
    return Scenery(tuple(name for name in scenery.names if name not in unseen), parts, colors)


def _load_photograph(scene: Scene) -> Picture | None:
    data = scene.files().get(PHOTOGRAPH)
    if data is None:
        return None
    photo = read_photograph(data, f"scene {scene.scene_id}: its photograph", WIDTH)
    if photo.width < WIDTH:  # it is compared with the twin, which is drawn at this width
        photo = photo.resize((WIDTH, round(photo.height * WIDTH / photo.width)), Image.Resampling.LANCZOS)
    return np.asarray(photo)


def _save(picture: Picture, stem: Path, thumb: bool) -> None:
    image = Image.fromarray(np.ascontiguousarray(picture))
    write_atomic(stem.with_name(stem.name + ".jpg"), encode_jpeg(image, _JPEG_QUALITY))
    if thumb:
        _save_small(image, stem)


def _save_small(image: Image.Image, stem: Path) -> None:
    size = (THUMB_WIDTH, max(1, round(image.height * THUMB_WIDTH / image.width)))
    small = image if image.size == size else image.resize(size, Image.Resampling.BOX, reducing_gap=2.0)
    write_atomic(stem.with_name(stem.name + "-s.jpg"), encode_jpeg(small, _JPEG_QUALITY - 6))


def encode_jpeg(image: Image.Image, quality: int) -> bytes:
    """Encode a picture as the bytes of a JPEG file."""
    file = io.BytesIO()
    image.save(file, "JPEG", quality=quality, optimize=True)
    return file.getvalue()
