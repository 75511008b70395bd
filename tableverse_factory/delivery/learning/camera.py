"""Pictures of a cell while it runs, by rays on the CPU: no GL and no display, the same bytes again."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from schemas.geometry import Picture, Pose, Texture, TriangleMesh
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.episodes.actors import ArmFigure, cast_with
from tableverse_factory.delivery.episodes.cameras import robot_eye
from tableverse_factory.delivery.episodes.incremental_renderer import MovingPictures, Props
from tableverse_factory.geometry.math.transforms import normalized_quaternion
from tableverse_factory.physics.mjcf.scene_objects import slab_of
from tableverse_factory.physics.render.render import Lighting
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.sources.textures.catalogue import TILE_M, texture

_TEXTURE_PX = 512


class Sight:
    """A camera that stands with the robot, across the table from it, as the exports for learning have it."""

    def __init__(
        self,
        scene: Scene,
        arm: Arm,
        base: Pose,
        size: tuple[int, int],
        table: int | None = None,
        lighting: Lighting | None = None,
    ) -> None:
        """Draws what stands still.

        Args:
            scene: All its objects may move.
            arm: Beside it.
            base: Of the arm, in the table frame.
            size: Height and width of the pictures [px].
            table: Seed of a texture for the table; None leaves it as it is.
            lighting: Soft daylight by default.

        Raises:
            InputError: if the scene does not load, or has no table.
        """
        self._figure, self._base = ArmFigure(arm), base
        objects = {str(item["object_id"]) for item in scene.meta["objects"]}
        cast = cast_with(scene, objects, self._figure, base)
        still = cast.still if table is None else _with_table(cast.still, scene, table)
        self._names = cast.names
        self._pictures = MovingPictures(still, cast.moving, robot_eye(base, size[1], size[0]), lighting)

    def picture(self, poses: Mapping[str, np.ndarray], positions: np.ndarray) -> Picture:
        """What it sees.

        Args:
            poses: Of each object: position [m] and quaternion wxyz in the table frame. Each of shape (7,).
            positions: Of the arm's joints and fingers. Shape (j + f,).
        """
        objects = [Pose(poses[name][:3].copy(), normalized_quaternion(poses[name][3:])) for name in self._names]
        return self._pictures.frame([*objects, *self._figure.poses(positions, self._base)])


def _with_table(still: Props, scene: Scene, seed: int) -> Props:
    """The table, which is the last part but the pedestal, in another texture."""
    index, slab = len(still.meshes) - 2, slab_of(scene.files())
    board = still.meshes[index]
    c, s = np.cos(slab.yaw), np.sin(slab.yaw)
    along = (board.vertices[:, :2] - slab.center_xy) @ np.array([[c, -s], [s, c]]) / TILE_M
    covered = TriangleMesh(board.vertices, board.faces, texture=Texture(texture(seed, _TEXTURE_PX), along[board.faces]))
    meshes, paints = list(still.meshes), list(still.paints)
    meshes[index], paints[index] = covered, None
    return replace(still, meshes=tuple(meshes), paints=tuple(paints))
