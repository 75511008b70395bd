"""One browser's 3D view: meshes are sent once, then only where they are."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.delivery.formats.model_contents import VisualMesh
from tableverse_factory.geometry.math.transforms import identity_pose
from tableverse_factory.viz.viewer.glb import look_glb
from tableverse_factory.viz.viewer.layouts import Poses
from tableverse_factory.viz.viewer.loaded_scene import OpenedScene, Still, VisualBody
from tableverse_factory.viz.viewer.motion import MotionPlayback
from tableverse_factory.viz.viewer.simulation import Contacts
from tableverse_factory.viz.viewer.viewpoint import Viewpoint

GHOST_COLORS = {"observed": (226, 125, 30), "rectified": (150, 80, 200), "settled": (40, 130, 90)}
CONTACT_COLOR = (190, 0, 40)
_GHOST_OPACITY = 0.38
_LIGHT = {"hdri": "studio", "environment_intensity": 0.3}
"""Of the surroundings: viser brings the picture along, and what is white does not drown in light."""

_SKY = np.linspace((206, 214, 222), (240, 242, 244), 64).astype(np.uint8)[:, None].repeat(2, axis=1)
_ARM_COLOR = (200, 200, 200)
_ARROW = {"shaft_radius": 0.0016, "head_radius": 0.004, "head_length": 0.009}


class Canvas:
    """What one client sees of a scene. Names of nodes are numbers: no text from a dataset is part of one."""

    def __init__(self, client: Any) -> None:
        """Begins with nothing.

        Args:
            client: A `viser.ClientHandle`.
        """
        self._client = client
        self._viewpoint: Viewpoint | None = None
        self._aspect = 0.0
        client.camera.on_update(self._resized)
        client.scene.configure_environment_map(**_LIGHT)
        self._clear()

    def _clear(self) -> None:
        self._figures: tuple[VisualBody, ...] = ()
        self._frames: dict[str, Any] = {}
        self._looks: list[Any] = []
        self._pieces: list[Any] = []
        self._still: list[Any] = []
        self._labels: list[Any] = []
        self._ghosts: dict[str, list[Any]] = {}
        self._arm: list[Any] = []
        self._contacts: Any = None

    def open(self, opened: OpenedScene) -> None:
        """Shows another scene, in its settled layout."""
        self.close()
        scene, self._figures = self._client.scene, opened.figures
        scene.set_background_image(_SKY)
        for number, figure in enumerate(opened.figures):
            name = f"/objects/{number}"
            self._frames[figure.name] = scene.add_frame(name, show_axes=False, **_placed(opened.settled[figure.name]))
            if figure.look:
                self._looks.append(scene.add_glb(f"{name}/look", figure.look))
        self.lay(opened.still)

    def close(self) -> None:
        """Shows nothing."""
        self._client.scene.reset()
        self._clear()

    def lay(self, still: Still) -> None:
        """Shows what stands still, in place of what did: the table."""
        for handle in self._still:
            handle.remove()
        self._still = [
            self._client.scene.add_glb(f"/still/{number}", data, **_placed(pose))
            for number, (data, pose) in enumerate(still)
        ]

    def place(self, poses: Poses) -> None:
        """Moves objects; one without a pose is not there."""
        with self._client.atomic():
            for name, frame in self._frames.items():
                if frame.visible != (name in poses):
                    frame.visible = name in poses
                if name in poses:
                    _move(frame, poses[name])

    def show(self, looks: bool, pieces: bool) -> None:
        """Shows what is seen, what collides, both or neither. Pieces are sent when they are first wanted."""
        if pieces and not self._pieces:
            scene = self._client.scene
            self._pieces = [
                scene.add_glb(f"/objects/{number}/pieces", figure.pieces)
                for number, figure in enumerate(self._figures)
                if figure.pieces
            ]
        for handles, wanted in ((self._looks, looks), (self._pieces, pieces)):
            for handle in handles:
                handle.visible = wanted

    def label(self, names: Mapping[str, str], shown: bool) -> None:
        """Writes the names of the objects beside them.

        Args:
            names: By object; one line each.
            shown: Whether they are seen.
        """
        if shown and not self._labels:
            self._labels = [
                self._client.scene.add_label(
                    f"/objects/{number}/name",
                    names.get(figure.name, figure.name),
                    position=figure.shape.vertices.mean(axis=0) if len(figure.shape.vertices) else (0.0, 0.0, 0.0),
                    anchor="bottom-center",
                )
                for number, figure in enumerate(self._figures)
            ]
        for handle in self._labels:
            handle.visible = shown

    def ghost(self, layout: str | None, poses: Poses) -> None:
        """Shows the objects once more, transparent, as they stand in another layout; None shows none."""
        if layout is not None and layout not in self._ghosts:
            self._ghosts[layout] = [
                self._ghost(f"/ghosts/{layout}/{number}", figure.shape, poses[figure.name], layout)
                for number, figure in enumerate(self._figures)
                if figure.name in poses and len(figure.shape.faces)
            ]
        for name, handles in self._ghosts.items():
            for handle in handles:
                handle.visible = name == layout

    def _ghost(self, name: str, mesh: TriangleMesh, pose: Pose, layout: str) -> Any:
        return self._client.scene.add_mesh_simple(
            name,
            mesh.vertices,
            mesh.faces,
            color=GHOST_COLORS[layout],
            opacity=_GHOST_OPACITY,
            cast_shadow=False,
            receive_shadow=False,
            **_placed(pose),
        )

    def touch(self, contacts: Contacts | None) -> None:
        """Shows where things touch, an arrow along each normal, as long as the force is strong; None shows nothing."""
        if self._contacts is not None:
            self._contacts.remove()
            self._contacts = None
        if contacts is not None and len(contacts):
            self._contacts = self._client.scene.add_arrows("/contacts", contacts.arrows(), CONTACT_COLOR, **_ARROW)

    def staff(self, motion: MotionPlayback | None) -> None:
        """Shows the arm of a motion in place of any other."""
        for handle in self._arm:
            handle.remove()
        self._arm = []
        if motion is not None:
            meshes = [_arm_glb(mesh) for mesh in (*motion.meshes, motion.pedestal)]
            self._arm = [self._client.scene.add_glb(f"/arm/{k}", data) for k, data in enumerate(meshes)]

    def pose_arm(self, poses: Sequence[Pose]) -> None:
        """Moves the arm's parts; the pedestal stands."""
        with self._client.atomic():
            for handle, pose in zip(self._arm, (*poses, identity_pose()), strict=True):
                _move(handle, pose)

    def look_from(self, viewpoint: Viewpoint) -> None:
        """Puts the camera there."""
        camera = self._client.camera
        self._viewpoint, self._aspect = viewpoint, camera.aspect
        with self._client.atomic():
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.position = viewpoint.position
            camera.look_at = viewpoint.target
            camera.fov = viewpoint.field_of_view(camera.aspect)

    def _resized(self, camera: Any) -> None:
        """Keeps the whole picture in view when the canvas gets another shape."""
        if self._viewpoint is not None and abs(camera.aspect - self._aspect) > 1e-3:
            self._aspect = camera.aspect
            camera.fov = self._viewpoint.field_of_view(camera.aspect)


def _placed(pose: Pose) -> dict[str, np.ndarray]:
    return {"position": np.array(pose.position), "wxyz": np.array(pose.quaternion_wxyz)}


def _move(handle: Any, pose: Pose) -> None:
    handle.position, handle.wxyz = pose.position, pose.quaternion_wxyz


def _arm_glb(mesh: TriangleMesh) -> bytes:
    return look_glb([VisualMesh(mesh, _ARM_COLOR)])
