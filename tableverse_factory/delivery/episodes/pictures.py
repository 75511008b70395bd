"""Pictures that a policy sees: colours, depth and instances, the same in the environment and in exports."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from schemas.geometry import Pose
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.episodes.actors import ArmMeshes, RenderScene, build_render_scene
from tableverse_factory.delivery.episodes.cameras import (
    CameraShift,
    load_scene_camera,
    mount_wrist_camera,
    place_robot_camera,
    place_wrist_camera,
)
from tableverse_factory.delivery.episodes.incremental_renderer import IncrementalRenderer, View
from tableverse_factory.delivery.episodes.observation import list_objects, read_object_poses
from tableverse_factory.delivery.episodes.selection import Episode
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.geometry.math.transforms import compose_poses
from tableverse_factory.physics.render.render import Lighting
from tableverse_factory.robotics.execution.poses import pose_from_row
from tableverse_factory.robotics.robots.arm import Arm

CAMERAS = ("front", "wrist", "scene")
"""Across the table from the robot and to its left; on the hand; and the photograph's, which the arm may hide."""
DEPTH, INSTANCES = "_depth", "_instances"
PICTURES = tuple(camera + channel for camera in CAMERAS for channel in ("", DEPTH, INSTANCES))
"""`front` (h, w, 3) uint8 sRGB; `front_depth` (h, w, 1) float32 along the optical axis [m], at most `MAX_DEPTH_M`, 0
where nothing is; `front_instances` (h, w, 1) uint8: 1 + row in the states of objects, `TABLE_ID`, `ROBOT_ID`, else 0.
Likewise others."""
TABLE_ID, ROBOT_ID = 254, 255
MAX_DEPTH_M = 4.095  # twelve bits of millimetres, as videos have
MOVING_QUALITY = 1, 0  # samples and sky rays of a camera for which nothing stands still


def check_pictures(names: Sequence[str]) -> tuple[str, ...]:
    """Check names of pictures, and return each once."""
    for name in names:
        if name not in PICTURES:
            raise ConfigError(f"no picture {sanitize_line(str(name), 60)!r}; there are {', '.join(PICTURES)}")
    return tuple(dict.fromkeys(names))


class CameraRig:
    """Cameras on a scene and its arm, ready for any state."""

    def __init__(
        self,
        pictures: Sequence[str],
        scene: Scene,
        cast: RenderScene,
        arm: Arm,
        base: Pose,
        object_ids: Sequence[str],
        size: tuple[int, int],
        lighting: Lighting | None = None,
        shift: CameraShift | None = None,
    ) -> None:
        """Render the still parts for each camera that `pictures` names.

        `base` is the arm's in the table frame, `object_ids` in the order of the states of objects, `size` height and
        width [px]; `shift` displaces each camera.
        """
        self._pictures, self._mount = tuple(pictures), mount_wrist_camera(arm)
        if shift is not None:
            self._mount = compose_poses(self._mount, shift.pose)
        self._ids = number_parts(cast, object_ids)
        self._renderers = {
            name: IncrementalRenderer(
                cast.still,
                cast.moving,
                _place(name, scene, arm, base, size, shift),
                lighting,
                *MOVING_QUALITY if name == "wrist" else (),
            )
            for name in dict.fromkeys(picture.partition("_")[0] for picture in pictures)
        }

    def take(self, poses: Sequence[Pose], tcp: np.ndarray) -> dict[str, np.ndarray]:
        """Take the pictures with each moving part at its pose and the gripper at `tcp`, in the table frame."""
        taken: dict[str, np.ndarray] = {}
        for name, renderer in self._renderers.items():
            if name == "wrist":
                renderer.move_eye(compose_poses(pose_from_row(tcp), self._mount))
            only_color = not any(name + channel in self._pictures for channel in (DEPTH, INSTANCES))
            seen = {name: renderer.render(poses)} if only_color else self._split(name, renderer.render_view(poses))
            taken |= seen
        return {name: taken[name] for name in self._pictures}

    def _split(self, name: str, view: View) -> dict[str, np.ndarray]:
        instances, depth = self._ids[view.parts][..., None], np.minimum(view.depth, np.float32(MAX_DEPTH_M))[..., None]
        return {name: view.color, name + DEPTH: depth, name + INSTANCES: instances}


def _place(
    name: str, scene: Scene, arm: Arm, base: Pose, size: tuple[int, int], shift: CameraShift | None
) -> PosedCamera:
    eye = _place_unshifted(name, scene, arm, base, size)
    return eye if shift is None else shift.displace(eye)


def _place_unshifted(name: str, scene: Scene, arm: Arm, base: Pose, size: tuple[int, int]) -> PosedCamera:
    height, width = size
    if name == "front":
        return place_robot_camera(base, width, height)
    if name == "wrist":
        return place_wrist_camera(arm, base, width, height)
    eye = load_scene_camera(scene.meta, width, height)
    if eye is None:
        raise InputError(f"scene {scene.scene_id} was made without a camera: leave out `scene`", "no_camera")
    return eye


def number_parts(cast: RenderScene, object_ids: Sequence[str]) -> np.ndarray:
    """Give every mesh, the still ones first, its instance; the last entry is for nothing. Shape (parts + 1,)."""
    if len(object_ids) >= TABLE_ID:
        raise InputError(f"{len(object_ids)} objects: instances tell at most {TABLE_ID - 1} apart")
    known = {name: row + 1 for row, name in enumerate(object_ids)}
    objects = [known.get(name, 0) for name in cast.still_names]
    arm = [ROBOT_ID] * (len(cast.moving.meshes) - len(cast.names))
    moving = [known.get(name, 0) for name in cast.names]
    return np.array([*objects, TABLE_ID, ROBOT_ID, *moving, *arm, 0], dtype=np.uint8)


def take_recorded_pictures(
    pictures: Sequence[str], episode: Episode, arm: Arm, size: tuple[int, int], samples: Sequence[int]
) -> dict[str, list[np.ndarray]]:
    """Take pictures, by name, at samples of a recording; `size` is height and width [px]."""
    taken = list(iterate_recorded_pictures(pictures, episode, arm, size, samples))
    return {name: [each[name] for each in taken] for name in pictures}


def iterate_recorded_pictures(
    pictures: Sequence[str], episode: Episode, arm: Arm, size: tuple[int, int], samples: Sequence[int]
) -> Iterator[dict[str, np.ndarray]]:
    """Take pictures sample by sample."""
    recording, figure, model = episode.recording, ArmMeshes(arm), episode.scene.model()
    figure.check_recording(recording)
    names, objects = list_objects(model, episode), read_object_poses(model, episode)
    cast = build_render_scene(episode.scene, set(names), figure, recording.base)
    rig = CameraRig(pictures, episode.scene, cast, arm, recording.base, names, size)
    for sample in samples:
        bodies = figure.poses(recording.qpos[sample].astype(np.float64), recording.base)
        poses = join_poses(dict(zip(names, objects[sample], strict=True)), cast, bodies)
        yield rig.take(poses, recording.tcp[sample])


def join_poses(objects: Mapping[str, np.ndarray], cast: RenderScene, arm: Sequence[Pose]) -> list[Pose]:
    """List the poses of everything that moves: objects by id, then the arm's bodies."""
    return [*(pose_from_row(objects[name]) for name in cast.names), *arm]
