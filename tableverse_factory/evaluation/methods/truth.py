"""What is known to be true of a scene, in the three forms in which it lies around."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from schemas.geometry import Pose
from schemas.layout import MAX_OBJECTS, LayoutPose
from tableverse_factory.core.errors import GeometryError, InputError
from tableverse_factory.core.storage.untrusted import MAX_JSON_BYTES, finite_number, parse_json, read_bytes
from tableverse_factory.core.text import first_problem
from tableverse_factory.delivery.formats.model_contents import VisualMesh
from tableverse_factory.evaluation.methods.comparison import shared_names
from tableverse_factory.evaluation.methods.glb import GREY
from tableverse_factory.evaluation.methods.scenes import MethodObject, MethodScene
from tableverse_factory.evaluation.methods.sources import find_scenes, read_pose
from tableverse_factory.geometry.math.transforms import compose, inverse
from tableverse_factory.geometry.mesh.meshes import MAX_FILE_BYTES, read_mesh

CAPTURE_TRUTH = "truth.json"


@dataclass(frozen=True, slots=True)
class Truth:
    """How a scene truly is, in the frame of the result that it is compared with.

    Attributes:
        objects: With their true meshes, poses and scales.
        missing: Names of true objects that the result lacks, and whose meshes nobody knows therefore.
        named: Whether a result's object of the same name is the same object; else places decide.
        same_meshes: Whether the result's objects are these very meshes, at other poses and scales.
    """

    objects: tuple[MethodObject, ...]
    missing: tuple[str, ...]
    named: bool
    same_meshes: bool


class TrueObject(BaseModel):
    """An object of a synthetic capture; its mesh lies below the folder of `truth.json`."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    instance_id: int
    label: Annotated[str, Field(max_length=4000)]
    mesh: Annotated[str, Field(min_length=1, max_length=1024)]
    pose: LayoutPose


class CaptureTruth(BaseModel):
    """What `evaluate layout` needs of a `truth.json` of `tableverse synth`."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    camera_to_table: LayoutPose
    objects: Annotated[tuple[TrueObject, ...], Field(max_length=MAX_OBJECTS)]


ReadTruth = Callable[[MethodScene], Truth]


def find_truths(folder: Path) -> dict[str, ReadTruth]:
    """What there is to compare with, by the scene's name.

    - `<scene>.json`, object id to position, quaternion_wxyz and scale: true poses of the result's own meshes;
    - `<scene>/truth.json` of synthetic captures: true meshes; the camera, known to both sides, joins the frames;
    - any other scenes (`find_scenes`): true meshes with the same names in the same frame.

    Raises:
        InputError: `no_truth` if there is none of them.
    """
    captures = sorted(folder.glob(f"*/{CAPTURE_TRUTH}"))
    if captures:
        return {path.parent.name: partial(_of_capture, path) for path in captures}
    poses = {path.stem: _poses_in(path) for path in sorted(folder.glob("*.json"))}
    if poses and all(found is not None for found in poses.values()):
        return {name: partial(_of_poses, found) for name, found in poses.items() if found is not None}
    try:
        return {name: partial(_of_scene, its.read) for name, its in shared_names(find_scenes(folder)).items()}
    except InputError as error:
        raise InputError(f"{folder}: no truth there: {error}", "no_truth") from error


def _poses_in(path: Path) -> dict[str, tuple[Pose, float]] | None:
    """Poses and scales by object id; None if the file is something else."""
    try:
        value = parse_json(read_bytes(str(path), MAX_JSON_BYTES, "bad_truth"), path.name, "bad_truth")
        found = {str(name): (read_pose(entry), finite_number(entry.get("scale", 1.0))) for name, entry in value.items()}
    except (AttributeError, TypeError, InputError):
        return None
    known = {name: (pose, scale) for name, (pose, scale) in found.items() if scale is not None and scale > 0.0}
    return known if len(known) == len(found) else None


def _of_poses(poses: Mapping[str, tuple[Pose, float]], result: MethodScene) -> Truth:
    """True poses of the meshes that the result is made of."""
    objects = tuple(
        replace(item, pose=poses[item.name][0], scale=poses[item.name][1] / item.baked_scale, baked_scale=1.0)
        for item in result.objects
        if item.name in poses
    )
    missing = sorted(set(poses) - {item.name for item in objects})
    return Truth(objects, tuple(missing), named=True, same_meshes=True)


def _of_capture(path: Path, result: MethodScene) -> Truth:
    """True meshes of a synthetic capture, seen from the result's own table frame."""
    truth = _capture_truth(path)
    to_result: Callable[[Pose], Pose] = _same
    if result.camera_to_scene is not None:
        to_result = partial(
            compose, compose(result.camera_to_scene, inverse(read_pose(truth.camera_to_table.model_dump())))
        )
    objects = []
    for entry in truth.objects:
        try:
            data = read_bytes(str(_below(path.parent, entry.mesh)), MAX_FILE_BYTES, "bad_truth")
            mesh = read_mesh(data, entry.mesh)
        except GeometryError as error:
            raise InputError(f"{path}: {error}", "bad_truth") from error
        pose = to_result(read_pose(entry.pose.model_dump()))
        objects.append(MethodObject(f"{entry.instance_id}: {entry.label}", mesh, (VisualMesh(mesh, GREY),), pose))
    return Truth(tuple(objects), (), named=False, same_meshes=False)


def _of_scene(read: Callable[[], MethodScene], result: MethodScene) -> Truth:  # noqa: ARG001
    return Truth(read().objects, (), named=True, same_meshes=False)


def _same(pose: Pose) -> Pose:
    return pose


def _below(folder: Path, mesh: str) -> Path:
    path = (folder / mesh.replace("\0", "")).resolve()
    if not path.is_relative_to(folder.resolve()) or "\0" in mesh:
        raise InputError(f"mesh {mesh!r:.200}: give a path below {folder}", "bad_truth")
    return path


def _capture_truth(path: Path) -> CaptureTruth:
    value = parse_json(read_bytes(str(path), MAX_JSON_BYTES, "bad_truth"), str(path), "bad_truth")
    try:
        return CaptureTruth.model_validate(value)
    except ValidationError as error:
        raise InputError(f"{path}: no truth of a capture: {first_problem(error)}"[:400], "bad_truth") from None
