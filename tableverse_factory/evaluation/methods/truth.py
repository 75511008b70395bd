"""Ground truth of scenes in three formats: poses, synthetic captures, scenes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from schemas.error_text import describe_validation_error
from schemas.geometry import Pose
from schemas.layout import MAX_OBJECTS, LayoutPose
from tableverse_factory.core.errors import GeometryError, InputError
from tableverse_factory.core.storage.untrusted import MAX_JSON_BYTES, parse_finite, parse_json, read_bytes
from tableverse_factory.delivery.formats.model_contents import VisualMesh
from tableverse_factory.evaluation.methods.comparison import index_by_shared_name
from tableverse_factory.evaluation.methods.glb import GREY
from tableverse_factory.evaluation.methods.scenes import MethodObject, MethodScene
from tableverse_factory.evaluation.methods.sources import find_scenes, read_pose
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose
from tableverse_factory.geometry.mesh.meshes import MAX_FILE_BYTES, read_mesh

CAPTURE_TRUTH = "truth.json"


@dataclass(frozen=True, slots=True)
class SceneTruth:
    """Ground truth of a scene in the frame of the compared result."""

    objects: tuple[MethodObject, ...]  # with true meshes, poses and scales
    missing: tuple[str, ...]  # true objects that the result lacks and whose meshes are therefore unknown
    named: bool  # whether objects match by name; else by position
    same_meshes: bool  # whether the result has these meshes, at other poses and scales


class TrueObject(BaseModel):
    """An object of a synthetic capture; its mesh is below the folder of `truth.json`."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    instance_id: int
    label: Annotated[str, Field(max_length=4000)]
    mesh: Annotated[str, Field(min_length=1, max_length=1024)]
    pose: LayoutPose


class CaptureTruth(BaseModel):
    """The fields of a `truth.json` of `tableverse synth` that `evaluate layout` needs."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    camera_to_table: LayoutPose
    objects: Annotated[tuple[TrueObject, ...], Field(max_length=MAX_OBJECTS)]


ReadTruth = Callable[[MethodScene], SceneTruth]


def find_truths(folder: Path) -> dict[str, ReadTruth]:
    """Find the truths in a folder by scene name; raise `no_truth` if there is none.

    - `<scene>.json`, object id to position, quaternion_wxyz and scale: true poses of the result's own meshes;
    - `<scene>/truth.json` of synthetic captures: true meshes; the common camera relates the frames;
    - any other scenes (`find_scenes`): true meshes with the same names in the same frame.
    """
    captures = sorted(folder.glob(f"*/{CAPTURE_TRUTH}"))
    if captures:
        return {path.parent.name: partial(load_capture_truth, path) for path in captures}
    poses = {path.stem: _read_poses(path) for path in sorted(folder.glob("*.json"))}
    if poses and all(found is not None for found in poses.values()):
        return {name: partial(_load_pose_truth, found) for name, found in poses.items() if found is not None}
    try:
        return {
            name: partial(_load_scene_truth, its.read)
            for name, its in index_by_shared_name(find_scenes(folder)).items()
        }
    except InputError as error:
        raise InputError(f"{folder}: no truth in it: {error}", "no_truth") from error


def _read_poses(path: Path) -> dict[str, tuple[Pose, float]] | None:
    """Read poses and scales by object id; None if the file has another content."""
    try:
        value = parse_json(read_bytes(str(path), MAX_JSON_BYTES, "bad_truth"), path.name, "bad_truth")
        found = {str(name): (read_pose(entry), parse_finite(entry.get("scale", 1.0))) for name, entry in value.items()}
    except (AttributeError, TypeError, InputError):
        return None
    known = {name: (pose, scale) for name, (pose, scale) in found.items() if scale is not None and scale > 0.0}
    return known if len(known) == len(found) else None


def _load_pose_truth(poses: Mapping[str, tuple[Pose, float]], result: MethodScene) -> SceneTruth:
    objects = tuple(
        replace(item, pose=poses[item.name][0], scale=poses[item.name][1] / item.baked_scale, baked_scale=1.0)
        for item in result.objects
        if item.name in poses
    )
    missing = sorted(set(poses) - {item.name for item in objects})
    return SceneTruth(objects, tuple(missing), named=True, same_meshes=True)


def load_capture_truth(path: Path, result: MethodScene) -> SceneTruth:
    """Load the true meshes of a synthetic capture in the table frame of the result."""
    truth = _read_capture_truth(path)
    to_result: Pose | None = None  # the same frame
    if result.camera_to_scene is not None:
        table_to_camera = invert_pose(read_pose(truth.camera_to_table.model_dump()))
        to_result = compose_poses(result.camera_to_scene, table_to_camera)
    objects = []
    for entry in truth.objects:
        try:
            data = read_bytes(str(_resolve_below(path.parent, entry.mesh)), MAX_FILE_BYTES, "bad_truth")
            mesh = read_mesh(data, entry.mesh)
        except GeometryError as error:
            raise InputError(f"{path}: {error}", "bad_truth") from error
        pose = read_pose(entry.pose.model_dump())
        pose = pose if to_result is None else compose_poses(to_result, pose)
        objects.append(MethodObject(f"{entry.instance_id}: {entry.label}", mesh, (VisualMesh(mesh, GREY),), pose))
    return SceneTruth(tuple(objects), (), named=False, same_meshes=False)


def _load_scene_truth(read: Callable[[], MethodScene], result: MethodScene) -> SceneTruth:  # noqa: ARG001
    return SceneTruth(read().objects, (), named=True, same_meshes=False)


def _resolve_below(folder: Path, mesh: str) -> Path:
    path = (folder / mesh.replace("\0", "")).resolve()
    if not path.is_relative_to(folder.resolve()) or "\0" in mesh:
        raise InputError(f"mesh {mesh!r:.200}: give a path below {folder}", "bad_truth")
    return path


def _read_capture_truth(path: Path) -> CaptureTruth:
    value = parse_json(read_bytes(str(path), MAX_JSON_BYTES, "bad_truth"), str(path), "bad_truth")
    try:
        return CaptureTruth.model_validate(value)
    except ValidationError as error:
        raise InputError(
            f"{path}: no truth of a capture: {describe_validation_error(error)}"[:400], "bad_truth"
        ) from None
