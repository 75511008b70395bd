"""Camera pictures of a running simulation, ray-cast on the CPU: no GL, no display, deterministic."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from schemas.geometry import Texture, TriangleMesh
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.episodes.actors import ArmMeshes, RenderScene, build_render_scene
from tableverse_factory.delivery.episodes.cameras import CameraShift
from tableverse_factory.delivery.episodes.incremental_renderer import PaintedMeshes
from tableverse_factory.delivery.episodes.pictures import CameraRig, join_poses
from tableverse_factory.physics.mjcf.scene_objects import read_slab
from tableverse_factory.physics.render.render import Lighting
from tableverse_factory.robotics.robots.station import Station
from tableverse_factory.sources.textures.catalogue import TILE_M, make_texture

_TEXTURE_PX = 512


class SceneCameras:
    """Cameras of a running simulation: those of the episode exports, with every object free to move."""

    def __init__(
        self,
        scene: Scene,
        station: Station,
        object_ids: Sequence[str],
        pictures: Sequence[str],
        size: tuple[int, int],
        table: int | None = None,
        lighting: Lighting | None = None,
        shift: CameraShift | None = None,
    ) -> None:
        """Render the still parts.

        `object_ids` are in the order of the states of objects, `pictures` as in `episodes.pictures.PICTURES`, `size` is
        height and width [px], and `table` the seed of a texture for the table; None keeps its own. `shift` displaces
        each camera.
        """
        self._figure, self._base = ArmMeshes(station.arm), station.base
        cast = build_render_scene(scene, set(object_ids), self._figure, self._base)
        self._cast = cast if table is None else retexture_table(cast, scene, table)
        self._rig = CameraRig(pictures, scene, self._cast, station.arm, self._base, object_ids, size, lighting, shift)

    def take(self, poses: Mapping[str, np.ndarray], positions: np.ndarray, tcp: np.ndarray) -> dict[str, np.ndarray]:
        """Take the pictures at poses of the objects and the gripper, and positions of joints and fingers.

        Poses are position [m] and quaternion wxyz in the table frame.
        """
        return self._rig.take(join_poses(poses, self._cast, self._figure.poses(positions, self._base)), tcp)


def retexture_table(cast: RenderScene, scene: Scene, seed: int) -> RenderScene:
    """Replace the texture of the table, the last still mesh but the pedestal."""
    still = cast.still
    index, slab = len(still.meshes) - 2, read_slab(scene.files())
    board = still.meshes[index]
    c, s = np.cos(slab.yaw), np.sin(slab.yaw)
    along = (board.vertices[:, :2] - slab.center_xy) @ np.array([[c, -s], [s, c]]) / TILE_M
    texture = Texture(make_texture(seed, _TEXTURE_PX), along[board.faces])
    meshes, paints = list(still.meshes), list(still.paints)
    meshes[index], paints[index] = TriangleMesh(board.vertices, board.faces, texture=texture), None
    return replace(cast, still=PaintedMeshes(tuple(meshes), tuple(paints)))
