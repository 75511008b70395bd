"""Camera pictures of a running simulation, ray-cast on the CPU: no GL, no display, deterministic."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from schemas.geometry import Picture, Pose, Texture, TriangleMesh
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.episodes.actors import ArmMeshes, build_render_scene
from tableverse_factory.delivery.episodes.cameras import place_robot_camera
from tableverse_factory.delivery.episodes.incremental_renderer import IncrementalRenderer, PaintedMeshes
from tableverse_factory.physics.mjcf.scene_objects import read_slab
from tableverse_factory.physics.render.render import Lighting
from tableverse_factory.robotics.execution.poses import pose_from_row
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.sources.textures.catalogue import TILE_M, make_texture

_TEXTURE_PX = 512


class RobotCamera:
    """Camera across the table from the robot, as in the episode exports."""

    def __init__(
        self,
        scene: Scene,
        arm: Arm,
        base: Pose,
        size: tuple[int, int],
        table: int | None = None,
        lighting: Lighting | None = None,
    ) -> None:
        """Render the still parts; every object of the scene may move.

        `base` is the arm's, in the table frame, `size` height and width [px], and `table` the seed of a texture for the
        table; None keeps its own.
        """
        self._figure, self._base = ArmMeshes(arm), base
        objects = {str(item["object_id"]) for item in scene.meta["objects"]}
        cast = build_render_scene(scene, objects, self._figure, base)
        still = cast.still if table is None else _retexture_table(cast.still, scene, table)
        self._names = cast.names
        self._renderer = IncrementalRenderer(still, cast.moving, place_robot_camera(base, size[1], size[0]), lighting)

    def picture(self, poses: Mapping[str, np.ndarray], positions: np.ndarray) -> Picture:
        """Render the picture at object poses (position [m], quaternion wxyz) and positions of joints and fingers."""
        objects = [pose_from_row(poses[name]) for name in self._names]
        return self._renderer.render([*objects, *self._figure.poses(positions, self._base)])


def _retexture_table(still: PaintedMeshes, scene: Scene, seed: int) -> PaintedMeshes:
    """Replace the texture of the table, the last mesh but the pedestal."""
    index, slab = len(still.meshes) - 2, read_slab(scene.files())
    board = still.meshes[index]
    c, s = np.cos(slab.yaw), np.sin(slab.yaw)
    along = (board.vertices[:, :2] - slab.center_xy) @ np.array([[c, -s], [s, c]]) / TILE_M
    texture = Texture(make_texture(seed, _TEXTURE_PX), along[board.faces])
    meshes, paints = list(still.meshes), list(still.paints)
    meshes[index], paints[index] = TriangleMesh(board.vertices, board.faces, texture=texture), None
    return replace(still, meshes=tuple(meshes), paints=tuple(paints))
