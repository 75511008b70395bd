"""A scene loaded for the viewer: meshes, layouts, camera, photograph and rows, independent of any browser."""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from schemas.geometry import Frozen, Pose, TriangleMesh
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.dataset.preview_image import PHOTOGRAPH, read_photograph
from tableverse_factory.dataset.randomize import TableTexture
from tableverse_factory.delivery.episodes.cameras import load_scene_camera
from tableverse_factory.delivery.formats.model_contents import ModelContents, ModelObject, read_model_contents
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.geometry.mesh.meshes import concatenate_meshes
from tableverse_factory.physics.mjcf.file_check import check_files
from tableverse_factory.viz.viewer.glb import encode_pieces, encode_visuals
from tableverse_factory.viz.viewer.layouts import Poses, read_layouts
from tableverse_factory.viz.viewer.motion_playback import MotionPlayback
from tableverse_factory.viz.viewer.orbit_camera import OrbitCamera, make_front_camera, make_orbit_camera

StaticVisuals = tuple[tuple[bytes, Pose], ...]  # GLB of each static body in its own frame, pose in the table frame

PHOTOGRAPH_PX = 640
_QUALITY = 85


@dataclass(frozen=True, slots=True, eq=False)
class VisualBody(Frozen):
    """An object in its own frame."""

    name: str
    look: bytes  # GLB of the visual meshes; empty without any
    pieces: bytes  # GLB of the convex pieces
    n_pieces: int
    shape: TriangleMesh  # mesh of the whole object, for ghosts [m]
    mass_kg: float  # in the simulation [kg]


class LoadedScene:
    """An immutable scene, shared by all browsers that show it."""

    def __init__(self, scene: Scene) -> None:
        """Compile the model and read the scene; raise an `InputError` for joints other than free ones."""
        self.scene = scene
        self.meta: Mapping[str, Any] = scene.meta if "meta.json" in scene.files() else {}
        self.model = scene.model()
        if (self.model.jnt_type != mujoco.mjtJoint.mjJNT_FREE).any():
            raise InputError(
                "it has joints besides free ones, which exported scenes do not have; "
                "view it with python -m mujoco.viewer"
            )
        contents = read_model_contents(self.model)
        self.bodies = tuple(_encode_body(content, number) for number, content in enumerate(contents.objects))
        self.static = _encode_static(contents)
        self.settled = {content.name: content.pose for content in contents.objects}  # as exported
        self.layouts: dict[str, Poses] = read_layouts(self.meta, self.settled)
        self.viewpoint, self.has_camera = self._make_camera()

    @cached_property
    def photograph(self) -> bytes | None:
        """The photograph as JPEG, at most `PHOTOGRAPH_PX` wide; None without one."""
        data = self.scene.files().get(PHOTOGRAPH)
        if data is None:
            return None
        file = io.BytesIO()
        read_photograph(data, PHOTOGRAPH, PHOTOGRAPH_PX).save(file, "JPEG", quality=_QUALITY)
        return file.getvalue()

    @property
    def object_rows(self) -> tuple[Mapping[str, Any], ...]:
        """Rows of objects/; made from the files of the scene if it belongs to no dataset."""
        labels = {str(item["object_id"]): item.get("label") for item in self.meta.get("objects", [])}
        return tuple(self.scene.object_rows()) or tuple(
            {"object_id": body.name, "label": labels.get(body.name), "mass_kg": body.mass_kg} for body in self.bodies
        )

    def motion(self, task_id: str, robot: str | None) -> MotionPlayback:
        """Load the recorded motion of a task; raise an `InputError` if there is none, or the arm must be given."""
        trajectory = self.scene.trajectory(task_id)
        return MotionPlayback(trajectory.recording(), str(trajectory.row["x_id"]), robot)

    def retexture_table(self, texture: TableTexture | None) -> StaticVisuals:
        """Encode the static bodies with another texture on the table; None for that of the export."""
        if texture is None:
            return self.static
        return _encode_static(read_model_contents(self.scene.model(texture=texture)))

    def _make_camera(self) -> tuple[OrbitCamera, bool]:
        eye = load_scene_camera(dict(self.meta), *_read_image_size(self.meta))
        if eye is not None:
            return make_orbit_camera(eye), True
        points = [transform_points(self.settled[each.name], each.shape.vertices) for each in self.bodies]
        return make_front_camera(np.concatenate([*points, np.zeros((1, 3))])), False


def load_scene_file(path: Path) -> Scene:
    """Load an exported scene from its folder: `scene.xml`, its assets (none elsewhere), `meta.json`, photograph."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the scene.xml of an exported scene, or a dataset")
    root = path.resolve().parent
    files = {"scene.xml": path.read_bytes()}
    for named in check_files(path, root):
        files.setdefault(named.resolve().relative_to(root).as_posix(), named.read_bytes())
    files.pop(path.name if path.name != "scene.xml" else "", None)
    for name in ("meta.json", PHOTOGRAPH):
        if (root / name).is_file():
            files[name] = (root / name).read_bytes()
    return Scene(sanitize_line(root.name or "scene", 100), {}, files)


def _read_image_size(meta: Mapping[str, Any]) -> tuple[int, int]:
    """Read the image size of the calibrated camera [px]; `load_scene_camera` reports values out of range."""
    camera = meta.get("camera")
    width, height = (camera.get(key) if isinstance(camera, Mapping) else None for key in ("width", "height"))
    known = isinstance(width, int) and isinstance(height, int) and 0 < width <= 10**5 and 0 < height <= 10**5
    return (int(width), int(height)) if known else (PHOTOGRAPH_PX, PHOTOGRAPH_PX * 3 // 4)  # type: ignore[arg-type]


def _encode_static(contents: ModelContents) -> StaticVisuals:
    return tuple((encode_visuals(content.looks), content.pose) for content in contents.still if content.looks)


def _encode_body(content: ModelObject, number: int) -> VisualBody:
    meshes = [look.mesh for look in content.looks] or list(content.hulls)
    return VisualBody(
        content.name,
        encode_visuals(content.looks),
        encode_pieces(content.hulls, number),
        len(content.hulls),
        concatenate_meshes([*meshes, *content.unseen]),
        content.mass_kg,
    )


def merge_poses(base: Poses, moved: Poses) -> dict[str, Pose]:
    """Return the base poses with some objects moved."""
    return {**base, **{name: pose for name, pose in moved.items() if name in base}}
