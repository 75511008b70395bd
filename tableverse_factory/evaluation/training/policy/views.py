"""View of a scene as a policy on pictures looks at it: windows of its cameras' pictures, and names of objects."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Int16
from PIL import Image

from schemas.curation import INSTRUCTION, Relation
from schemas.geometry import DepthImage, Frozen, Pose
from tableverse_factory.delivery.episodes.actors import ArmMeshes, RenderScene
from tableverse_factory.delivery.episodes.incremental_renderer import IncrementalRenderer
from tableverse_factory.delivery.episodes.incremental_renderer import View as Drawn
from tableverse_factory.delivery.episodes.instructions import PARAPHRASES
from tableverse_factory.delivery.episodes.pictures import MAX_DEPTH_M, MOVING_QUALITY, TABLE_ID, number_parts
from tableverse_factory.evaluation.training.policy.mounts import list_intrinsics, list_mounts, mount_cameras
from tableverse_factory.evaluation.training.policy.packed_pictures import (
    CAMERAS,
    DEPTH_M,
    OBJECTS,
    PART_WORDS,
    PHRASE_WORDS,
    PHRASES,
    PackedPictures,
    number_words,
)
from tableverse_factory.evaluation.training.policy.windows import crop_eye, find_window, thin_eye
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.geometry.math.transforms import compose_poses
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.physics.render.raycast import Raycaster
from tableverse_factory.physics.render.render import Lighting
from tableverse_factory.robotics.robots.registry import load_arm

QUALITY = 92  # of colours


@cache
def load_figure(robot: str) -> ArmMeshes:
    """Load the meshes of an arm, once in a process."""
    return ArmMeshes(load_arm(robot))


@dataclass(frozen=True, slots=True, eq=False)
class PosedScene(Frozen):
    """Scene with its arm at home: poses of `cast.moving` and the base in the table frame, and phrases for each object.

    `object_ids` are in the order in which objects are numbered from 1.
    """

    cast: RenderScene
    object_ids: Sequence[str]
    poses: Sequence[Pose]
    base: Pose
    phrases: Mapping[str, Sequence[str]]
    lighting: Lighting | None = None


@dataclass(frozen=True, slots=True, eq=False)
class View(Frozen):
    """Encoded pictures by camera and channel, intrinsics of their windows, base of the arm, and words of phrases."""

    files: tuple[bytes, ...]
    intrinsics: np.ndarray
    base: Pose
    words: np.ndarray


def take_view(posed: PosedScene, robot: str) -> View:
    """Take the pictures of a scene."""
    files: list[bytes] = []
    intrinsics, numbers = [], number_parts(posed.cast, posed.object_ids)
    moving = [place_mesh(mesh, pose) for mesh, pose in zip(posed.cast.moving.meshes, posed.poses, strict=True)]
    caster = Raycaster([*posed.cast.still.meshes, *moving])
    for camera, mount in zip(CAMERAS, mount_cameras(robot), strict=True):
        thin = thin_eye(mount)
        window = crop_eye(mount, *find_window(_cast_depth(caster, thin, posed.base), thin))
        eye = PosedCamera(window.camera, compose_poses(posed.base, window.camera_to_table))
        quality = MOVING_QUALITY if camera == "wrist" else ()
        renderer = IncrementalRenderer(posed.cast.still, posed.cast.moving, eye, posed.lighting, *quality)
        files += _encode(renderer.render_view(posed.poses), numbers)
        intrinsics.append(list_intrinsics(window))
    return View(tuple(files), np.stack(intrinsics), posed.base, _number_phrases(posed))


def _cast_depth(caster: Raycaster, thin: PosedCamera, base: Pose) -> DepthImage:
    """Cast the depth of a camera in the frame of the arm's base [m]."""
    hits = caster.cast(thin.camera, compose_poses(base, thin.camera_to_table))
    depth = np.zeros((thin.camera.height, thin.camera.width), dtype=np.float32)
    depth.ravel()[hits.pixels] = hits.depth
    return depth


def _number_phrases(posed: PosedScene) -> np.ndarray:
    """Number the words of each object's phrases that are short enough. Shape (`OBJECTS`, `PHRASES`, `PHRASE_WORDS`)."""
    found = np.zeros((OBJECTS, PHRASES, PHRASE_WORDS), dtype=np.int16)
    for row, name in enumerate(posed.object_ids[:OBJECTS]):
        numbers = [number_words(phrase, PHRASE_WORDS + 1) for phrase in posed.phrases.get(name, ())]
        whole = [own[:-1] for own in numbers if own[-1] == 0][:PHRASES]
        found[row, : len(whole)] = np.reshape(whole, (-1, PHRASE_WORDS))
    return found


def _encode(drawn: Drawn, numbers: np.ndarray) -> tuple[bytes, ...]:
    """Encode colours, depth and objects as files."""
    instances = numbers[drawn.parts]
    steps = np.rint(np.minimum(drawn.depth, MAX_DEPTH_M) / DEPTH_M).astype(np.uint16)  # 32,760 steps at most
    objects = np.where(instances < TABLE_ID, instances, 0).astype(np.uint8)
    return _write(drawn.color, "JPEG", quality=QUALITY), _write(steps, "PNG"), _write(objects, "PNG")


def _write(picture: np.ndarray, kind: str, **options: int) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, kind, **options)
    return file.getvalue()


def join_views(robot: str, views: Sequence[tuple[View, bool]]) -> PackedPictures:
    """Join views, each with whether it is held out."""
    files = [file for view, _ in views for file in view.files]
    return PackedPictures(
        files=np.frombuffer(b"".join(files), np.uint8),
        ends=np.cumsum([len(file) for file in files], dtype=np.int64).reshape(-1, len(CAMERAS), 3),
        intrinsics=np.stack([view.intrinsics for view, _ in views]),
        mounts=list_mounts(mount_cameras(robot)),
        bases=np.array([[*v.base.position, *v.base.quaternion_wxyz] for v, _ in views], dtype=np.float32),
        held_out=np.array([held_out for _, held_out in views], dtype=np.uint8),
        words=np.stack([view.words for view, _ in views]),
        wordings=list_wordings(),
    )


def list_wordings() -> Int16[np.ndarray, "n 3 w"]:
    """List the words around the phrases of X and Y in every wording of an instruction, for every relation."""
    texts = [
        text.format(x="|", relation=relation.value, y="|")
        for text in (INSTRUCTION, *PARAPHRASES)
        for relation in Relation
    ]
    return np.array([[number_words(part, PART_WORDS) for part in text.split("|")] for text in texts])
