"""First stage: read a row of the manifest as an observation, or as a layout with its meshes."""

from typing import Protocol

import numpy as np

from schemas.config import Config
from schemas.geometry import Pose, TriangleMesh
from schemas.known_length import KnownLength, parse_known_length
from schemas.layout import LayoutObject
from schemas.manifest import ImageRow, SceneKind
from schemas.objects import LARGEST_M, SMALLEST_M, PlacedObject, PlacedObjects, Table
from schemas.observation import Observation
from schemas.outcome import Done, Dropped, Outcome
from tableverse_factory.core.errors import AnswerInvalidError, InputError
from tableverse_factory.geometry.math.aabb import aabb, aabb_size
from tableverse_factory.geometry.math.transforms import normalize_quaternion
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.models.services import Services
from tableverse_factory.sources.capture import Capture, read_capture, read_recorded_meshes
from tableverse_factory.sources.content_hash import verify_content_hash
from tableverse_factory.sources.image_file import read_image
from tableverse_factory.sources.known_length import check_pixels, rescale_pixels
from tableverse_factory.sources.layout_file import read_layout_file, read_layout_meshes
from tableverse_factory.stages.observe.depth.depth_anything_2 import estimate_depth_anything_2
from tableverse_factory.stages.observe.depth.depth_anything_3 import (
    estimate_depth_anything_3,
    estimate_depth_anything_3_nested,
)
from tableverse_factory.stages.observe.depth.moge import estimate_moge_2
from tableverse_factory.stages.observe.depth.picture import estimate_picture_depth
from tableverse_factory.stages.observe.depth.recorded import read_recorded_depth

TABLE_MARGIN_M = 0.15
TABLE_COLOR = (176, 148, 116)


class DepthModel(Protocol):
    """Interface of depth models, which give a picture metric depth and a camera."""

    def __call__(self, item: ImageRow, config: Config) -> Capture:
        """Return the picture with its depth; `InputError` and `AnswerInvalidError` drop the row."""
        ...


def read_sensor_depth(item: ImageRow, config: Config) -> Capture:
    """Read the sensor depth of a capture; a bare picture has none."""
    if item.kind is not SceneKind.CAPTURE:
        raise InputError(
            "a picture without depth needs a depth model, and observe.depth is 'sensor', which reads the depth of a "
            "capture: set it to one of " + ", ".join(name for name in DEPTH_MODELS if name != "sensor") + " "
            "(docs/models.md), or give captures (color.png, depth.png, camera.json)",
            "no_depth_model",
        )
    return read_capture(item.uri, config.observe)


DEPTH_MODELS: dict[str, DepthModel] = {
    "sensor": read_sensor_depth,
    "picture": estimate_picture_depth,
    "recorded": read_recorded_depth,
    "depth_anything_3": estimate_depth_anything_3,
    "depth_anything_3_nested": estimate_depth_anything_3_nested,
    "moge_2": estimate_moge_2,
    "depth_anything_2": estimate_depth_anything_2,
}


def observe(item: ImageRow, config: Config, rng: np.random.Generator, services: Services) -> Outcome[Observation]:  # noqa: ARG001
    """Read a capture, or a picture with the depth model; unusable rows are dropped with the reason."""
    if item.rejected:
        return Dropped(item.rejected, item.rejected_detail)
    try:
        verify_content_hash(item, config.observe)
        capture = DEPTH_MODELS["sensor" if item.kind is SceneKind.CAPTURE else config.observe.depth](item, config)
        is_replay = config.place.mesh_model == "replay"
        meshes = read_recorded_meshes(item.uri, capture.ids, config.observe) if is_replay else ()
        known = _read_known_length(item, capture, config)
    except (InputError, AnswerInvalidError) as error:
        return Dropped(error.reason, str(error))
    fields = (capture.color, capture.depth, capture.camera, capture.detections, capture.ids)
    origin = (capture.scale_sigma, capture.scale_source, capture.intrinsics_source)
    return Done(Observation(item.scene_id, *fields, meshes, capture.bend, *origin, known))


def _read_known_length(item: ImageRow, capture: Capture, config: Config) -> KnownLength | None:
    """Read the known length of a row, with its pixels in the size of the observation's picture."""
    if not item.known_length:
        return None
    known = parse_known_length(item.known_length)
    height, width = capture.color.shape[:2]
    file = read_image(item.uri, config.observe) if item.kind is SceneKind.IMAGE and known.pixels else capture.color
    check_pixels(known, file.shape[1], file.shape[0])
    return rescale_pixels(known, (file.shape[1], file.shape[0]), (width, height))


def read_layout(item: ImageRow, config: Config, rng: np.random.Generator, services: Services) -> Outcome[PlacedObjects]:  # noqa: ARG001
    """Read a layout file and its meshes; the table is as large as the objects and a margin."""
    if item.rejected:
        return Dropped(item.rejected, item.rejected_detail)
    try:
        verify_content_hash(item, config.observe)
        layout = read_layout_file(item.uri)
        meshes = read_layout_meshes(item.uri, layout, config.observe)
    except InputError as error:
        return Dropped(error.reason, str(error))
    objects = tuple(_place_entry(entry, meshes[entry.mesh]) for entry in layout.objects)
    return Done(PlacedObjects(item.scene_id, _fit_table(objects), objects))


def _place_entry(entry: LayoutObject, mesh: TriangleMesh) -> PlacedObject:
    pose = Pose(np.array(entry.pose.position), normalize_quaternion(np.array(entry.pose.quaternion_wxyz)))
    return PlacedObject(entry.id, entry.label, 1.0, mesh, entry.scale, pose, entry.contained_in, entry.count)


def _fit_table(objects: tuple[PlacedObject, ...]) -> Table:
    """Fit an axis-aligned table-top under all objects of plausible size, `TABLE_MARGIN_M` larger on each side.

    Rectification leaves the others out; a mesh in millimetres would make a table of a hundred metres.
    """
    sizes = [o.scale * float(aabb_size(o.mesh.vertices).max()) for o in objects]
    plausible = [o for o, size in zip(objects, sizes, strict=True) if SMALLEST_M <= size <= LARGEST_M]
    boxes = [aabb(place_mesh(o.mesh, o.pose, o.scale).vertices) for o in plausible or objects]
    low = np.min([box[0] for box in boxes], axis=0)[:2]
    high = np.max([box[1] for box in boxes], axis=0)[:2]
    return Table((low + high) / 2, (high - low) / 2 + TABLE_MARGIN_M, 0.0, TABLE_COLOR, 0.0)
