"""The first stage: a row of the manifest becomes an observation, or a layout with its meshes."""

from typing import Protocol

import numpy as np

from schemas.config import Config
from schemas.geometry import Pose, TriangleMesh
from schemas.layout import LayoutObject
from schemas.manifest import ImageRow, SceneKind
from schemas.objects import PlacedObject, PlacedObjects, Table
from schemas.observation import Observation
from schemas.outcome import Done, Dropped, Outcome
from tableverse_factory.core.errors import AnswerInvalidError, InputError
from tableverse_factory.geometry.math.transforms import normalized_quaternion
from tableverse_factory.geometry.mesh.meshes import bounds, placed_mesh
from tableverse_factory.models.services import Services
from tableverse_factory.sources.capture import Capture, read_capture, read_recorded_meshes
from tableverse_factory.sources.content_hash import verify_content_hash
from tableverse_factory.sources.layout_file import read_layout_file, read_layout_meshes
from tableverse_factory.stages.observe.depth.depth_anything_2 import depth_anything_2
from tableverse_factory.stages.observe.depth.depth_anything_3 import depth_anything_3, depth_anything_3_nested
from tableverse_factory.stages.observe.depth.moge import moge_2
from tableverse_factory.stages.observe.depth.recorded import recorded

TABLE_MARGIN_M = 0.15
TABLE_COLOR = (176, 148, 116)


class DepthModel(Protocol):
    """The door of everything that gives a picture its metric depth and camera."""

    def __call__(self, item: ImageRow, config: Config) -> Capture:
        """The picture with its depth.

        Raises:
            InputError: with a reason, where this model can say nothing about such a row.
            AnswerInvalidError: where it gives none.
            ModelAccessError: where it is not installed, or has no weights.
        """
        ...


def sensor_depth(item: ImageRow, config: Config) -> Capture:
    """The capture's own depth.

    Raises:
        InputError: `no_depth_model` for a bare picture, else as `read_capture`.
    """
    if item.kind is not SceneKind.CAPTURE:
        raise InputError(
            "a picture without depth needs a depth model, and observe.depth is 'sensor', which reads the depth of a "
            "capture: set it to one of " + ", ".join(name for name in DEPTH_MODELS if name != "sensor") + " "
            "(docs/models.md), or give captures (color.png, depth.png, camera.json)",
            "no_depth_model",
        )
    return read_capture(item.uri, config.observe)


DEPTH_MODELS: dict[str, DepthModel] = {
    "sensor": sensor_depth,
    "recorded": recorded,
    "depth_anything_3": depth_anything_3,
    "depth_anything_3_nested": depth_anything_3_nested,
    "moge_2": moge_2,
    "depth_anything_2": depth_anything_2,
}


def observe(item: ImageRow, config: Config, rng: np.random.Generator, services: Services) -> Outcome[Observation]:  # noqa: ARG001
    """Reads a capture, or a picture through the depth model; what cannot be used is dropped with its reason.

    Raises:
        ModelAccessError: if the depth model is not installed, or its weights are not there.
    """
    if item.rejected:
        return Dropped(item.rejected, item.rejected_detail)
    try:
        verify_content_hash(item, config.observe)
        found = DEPTH_MODELS["sensor" if item.kind is SceneKind.CAPTURE else config.observe.depth](item, config)
        replayed = config.place.mesh_model == "replay"
        meshes = read_recorded_meshes(item.uri, found.ids, config.observe) if replayed else ()
    except (InputError, AnswerInvalidError) as error:
        return Dropped(error.reason, str(error))
    seen = (found.color, found.depth, found.camera, found.detections, found.ids)
    return Done(Observation(item.scene_id, *seen, meshes, found.bend))


def read_layout(item: ImageRow, config: Config, rng: np.random.Generator, services: Services) -> Outcome[PlacedObjects]:  # noqa: ARG001
    """Reads a layout file and its meshes; the table is as large as the objects and a margin."""
    if item.rejected:
        return Dropped(item.rejected, item.rejected_detail)
    try:
        verify_content_hash(item, config.observe)
        layout = read_layout_file(item.uri)
        meshes = read_layout_meshes(item.uri, layout, config.observe)
    except InputError as error:
        return Dropped(error.reason, str(error))
    objects = tuple(_placed(entry, meshes[entry.mesh]) for entry in layout.objects)
    return Done(PlacedObjects(item.scene_id, _table_under(objects), objects))


def _placed(entry: LayoutObject, mesh: TriangleMesh) -> PlacedObject:
    pose = Pose(np.array(entry.pose.position), normalized_quaternion(np.array(entry.pose.quaternion_wxyz)))
    return PlacedObject(entry.id, entry.label, 1.0, mesh, entry.scale, pose, entry.contained_in, entry.count)


def _table_under(objects: tuple[PlacedObject, ...]) -> Table:
    """An axis-aligned table-top under all objects, `TABLE_MARGIN_M` larger on each side."""
    boxes = [bounds(placed_mesh(o.mesh, o.pose, o.scale)) for o in objects]
    low = np.min([box[0] for box in boxes], axis=0)[:2]
    high = np.max([box[1] for box in boxes], axis=0)[:2]
    return Table((low + high) / 2, (high - low) / 2 + TABLE_MARGIN_M, 0.0, TABLE_COLOR, 0.0)
