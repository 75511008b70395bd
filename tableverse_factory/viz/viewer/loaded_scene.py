"""A scene made ready to be looked at: meshes to send once, layouts, camera, photograph, facts; nothing of a browser."""

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
from tableverse_factory.delivery.episodes.cameras import scene_eye
from tableverse_factory.delivery.formats.model_contents import ModelContents, ModelObject, contents_of
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.physics.mjcf.file_check import check_files
from tableverse_factory.physics.simulate.model_solids import joined
from tableverse_factory.viz.viewer.glb import look_glb, pieces_glb
from tableverse_factory.viz.viewer.layouts import SETTLED, Poses, layouts_of
from tableverse_factory.viz.viewer.motion import MotionPlayback
from tableverse_factory.viz.viewer.viewpoint import Viewpoint, front_viewpoint, viewpoint_of

Still = tuple[tuple[bytes, Pose], ...]
"""GLB of what is seen of each thing that never moves, in its own frame, and that frame in the table frame."""

PHOTOGRAPH_PX = 640
_QUALITY = 85


@dataclass(frozen=True, slots=True, eq=False)
class VisualBody(Frozen):
    """One object, in its own frame.

    Attributes:
        name: Of the object, as in the model.
        look: GLB of what is seen; empty where nothing is.
        pieces: GLB of its convex pieces.
        n_pieces: How many there are.
        shape: All of it as triangles, for ghosts [m].
        mass_kg: In the simulation.
    """

    name: str
    look: bytes
    pieces: bytes
    n_pieces: int
    shape: TriangleMesh
    mass_kg: float


class OpenedScene:
    """One scene, shared by all who look at it: nobody changes anything in it."""

    def __init__(self, scene: Scene) -> None:
        """Compiles the model and reads all that is shown.

        Args:
            scene: From a dataset, or from `scene_file`.

        Raises:
            InputError: if its model or its meta.json does not load, or it has joints that exported scenes do not have.
        """
        self.scene = scene
        self.meta: Mapping[str, Any] = scene.meta if "meta.json" in scene.files() else {}
        self.model = scene.model()
        _check_joints(self.model)
        contents = contents_of(self.model)
        self.figures = tuple(_figure(content, number) for number, content in enumerate(contents.objects))
        self.still = _still(contents)
        settled = {content.name: content.pose for content in contents.objects}
        self.layouts: dict[str, Poses] = layouts_of(self.meta, settled)
        self.viewpoint, self.has_camera = self._viewpoint()

    @property
    def settled(self) -> Poses:
        """Where the objects stand as exported."""
        return self.layouts[SETTLED]

    @cached_property
    def photograph(self) -> bytes | None:
        """The photograph as JPEG, at most `PHOTOGRAPH_PX` wide; None where there is none.

        Raises:
            InputError: if it does not decode.
        """
        data = self.scene.files().get(PHOTOGRAPH)
        if data is None:
            return None
        file = io.BytesIO()
        read_photograph(data, PHOTOGRAPH, PHOTOGRAPH_PX).save(file, "JPEG", quality=_QUALITY)
        return file.getvalue()

    @property
    def motion_rows(self) -> tuple[Mapping[str, Any], ...]:
        """Rows of trajectories/, in the order of the tasks; these and the next are read whenever somebody asks."""
        return tuple(self.scene.trajectory_rows())

    @property
    def object_rows(self) -> tuple[Mapping[str, Any], ...]:
        """Rows of objects/; from the scene's own files where it lies in no dataset."""
        labels = {str(item["object_id"]): item.get("label") for item in self.meta.get("objects", [])}
        return tuple(self.scene.object_rows()) or tuple(
            {"object_id": figure.name, "label": labels.get(figure.name), "mass_kg": figure.mass_kg}
            for figure in self.figures
        )

    @property
    def task_rows(self) -> tuple[Mapping[str, Any], ...]:
        """Rows of tasks/; none where the scene lies in no dataset."""
        return tuple(self.scene.task_rows())

    def motion(self, task_id: str, robot: str | None) -> MotionPlayback:
        """The recorded motion of a task.

        Raises:
            InputError: if there is none, its file is damaged, or the arm has to be given.
        """
        trajectory = self.scene.trajectory(task_id)
        return MotionPlayback(trajectory.recording(), str(trajectory.row["x_id"]), robot)

    def retextured(self, texture: TableTexture | None) -> Still:
        """What stands still with another texture on the table, as in `still`.

        Raises:
            InputError: if there is no such texture, or no table to lay it on.
        """
        if texture is None:
            return self.still
        return _still(contents_of(self.scene.model(texture=texture)))

    def _viewpoint(self) -> tuple[Viewpoint, bool]:
        eye = scene_eye(dict(self.meta), *_size(self.meta))
        if eye is not None:
            return viewpoint_of(eye), True
        points = [transform_points(self.settled[each.name], each.shape.vertices) for each in self.figures]
        return front_viewpoint(np.concatenate([*points, np.zeros((1, 3))])), False


def scene_file(path: Path) -> Scene:
    """One exported scene that lies in a folder, `scene.xml` with its assets and what else export wrote beside it.

    Raises:
        InputError: if there is none, or it names what is not below its folder.
    """
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


def _size(meta: Mapping[str, Any]) -> tuple[int, int]:
    """Of the picture that the camera was calibrated for [px]; what makes no sense is told by `scene_eye`."""
    camera = meta.get("camera")
    width, height = (camera.get(key) if isinstance(camera, Mapping) else None for key in ("width", "height"))
    known = isinstance(width, int) and isinstance(height, int) and 0 < width <= 10**5 and 0 < height <= 10**5
    return (int(width), int(height)) if known else (PHOTOGRAPH_PX, PHOTOGRAPH_PX * 3 // 4)  # type: ignore[arg-type]


def _check_joints(model: mujoco.MjModel) -> None:
    if (model.jnt_type != mujoco.mjtJoint.mjJNT_FREE).any():
        raise InputError("it has joints besides free ones, and exported scenes have none; python -m mujoco.viewer")


def _still(contents: ModelContents) -> Still:
    return tuple((look_glb(content.looks), content.pose) for content in contents.still if content.looks)


def _figure(content: ModelObject, number: int) -> VisualBody:
    meshes = [look.mesh for look in content.looks] or list(content.hulls)
    return VisualBody(
        content.name,
        look_glb(content.looks),
        pieces_glb(content.hulls, number),
        len(content.hulls),
        joined([*meshes, *content.unseen]),
        content.mass_kg,
    )


def poses_with(base: Poses, moved: Poses) -> dict[str, Pose]:
    """The base, with some objects elsewhere."""
    return {**base, **{name: pose for name, pose in moved.items() if name in base}}
