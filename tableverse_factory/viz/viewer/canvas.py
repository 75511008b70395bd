"""The 3D view of one browser: meshes are sent once, then only their poses."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from schemas.geometry import Pose
from tableverse_factory.delivery.formats.model_contents import VisualMesh
from tableverse_factory.geometry.math.transforms import identity_pose
from tableverse_factory.viz.viewer.glb import encode_visuals
from tableverse_factory.viz.viewer.layouts import Poses
from tableverse_factory.viz.viewer.loaded_scene import LoadedScene, StaticVisuals, VisualBody
from tableverse_factory.viz.viewer.motion_playback import MotionPlayback
from tableverse_factory.viz.viewer.orbit_camera import OrbitCamera
from tableverse_factory.viz.viewer.simulation import Contacts

GHOST_COLORS = {"observed": (226, 125, 30), "rectified": (150, 80, 200), "settled": (40, 130, 90)}
CONTACT_COLOR = (190, 0, 40)
_GHOST = {"opacity": 0.38, "cast_shadow": False, "receive_shadow": False}
_LIGHT = {"hdri": "studio", "environment_intensity": 0.3}  # environment map of viser, dim enough for white objects

_SKY = np.linspace((206, 214, 222), (240, 242, 244), 64).astype(np.uint8)[:, None].repeat(2, axis=1)
_ARM_COLOR = (200, 200, 200)
_ARROW = {"shaft_radius": 0.0016, "head_radius": 0.004, "head_length": 0.009}


class Canvas:
    """The scene nodes of one client. Nodes are named by numbers, never by text from a dataset."""

    def __init__(self, client: Any) -> None:
        """Begin with an empty view of a `viser.ClientHandle`."""
        self._client = client
        self._orbit_camera: OrbitCamera | None = None
        self._aspect = 0.0
        client.camera.on_update(self._on_camera_update)
        client.scene.configure_environment_map(**_LIGHT)
        self._clear()

    def _clear(self) -> None:
        self._bodies: tuple[VisualBody, ...] = ()
        self._frames: dict[str, Any] = {}
        self._looks: list[Any] = []
        self._pieces: list[Any] = []
        self._static: list[Any] = []
        self._labels: list[Any] = []
        self._ghosts: dict[str, list[Any]] = {}
        self._arm: list[Any] = []
        self._contacts: Any = None

    def open(self, loaded: LoadedScene) -> None:
        """Show a scene in its settled layout."""
        self.close()
        scene, self._bodies = self._client.scene, loaded.bodies
        scene.set_background_image(_SKY)
        for number, body in enumerate(loaded.bodies):
            name = f"/objects/{number}"
            self._frames[body.name] = scene.add_frame(
                name, show_axes=False, **_pose_arguments(loaded.settled[body.name])
            )
            if body.look:
                self._looks.append(scene.add_glb(f"{name}/look", body.look))
        self.set_static(loaded.static)

    def close(self) -> None:
        """Remove all nodes."""
        self._client.scene.reset()
        self._clear()

    def set_static(self, static: StaticVisuals) -> None:
        """Replace the static bodies, such as the table."""
        for handle in self._static:
            handle.remove()
        self._static = [
            self._client.scene.add_glb(f"/static/{number}", data, **_pose_arguments(pose))
            for number, (data, pose) in enumerate(static)
        ]

    def set_poses(self, poses: Poses) -> None:
        """Set the poses of the objects; hide those without one."""
        with self._client.atomic():
            for name, frame in self._frames.items():
                if frame.visible != (name in poses):
                    frame.visible = name in poses
                if name in poses:
                    _set_pose(frame, poses[name])

    def set_visibility(self, looks: bool, pieces: bool) -> None:
        """Show or hide visual meshes and collision pieces; pieces are sent when they are first shown."""
        if pieces and not self._pieces:
            scene = self._client.scene
            self._pieces = [
                scene.add_glb(f"/objects/{number}/pieces", body.pieces)
                for number, body in enumerate(self._bodies)
                if body.pieces
            ]
        for handles, wanted in ((self._looks, looks), (self._pieces, pieces)):
            for handle in handles:
                handle.visible = wanted

    def show_names(self, names: Mapping[str, str], shown: bool) -> None:
        """Show or hide the display names of the objects."""
        if shown and not self._labels:
            self._labels = [
                self._client.scene.add_label(
                    f"/objects/{number}/name",
                    names.get(body.name, body.name),
                    position=body.shape.vertices.mean(axis=0) if len(body.shape.vertices) else (0.0, 0.0, 0.0),
                    anchor="bottom-center",
                )
                for number, body in enumerate(self._bodies)
            ]
        for handle in self._labels:
            handle.visible = shown

    def show_ghost(self, layout: str | None, poses: Poses) -> None:
        """Show the objects transparently at the poses of another layout; None hides them."""
        if layout is not None and layout not in self._ghosts:
            self._ghosts[layout] = [
                self._client.scene.add_mesh_simple(
                    f"/ghosts/{layout}/{number}",
                    body.shape.vertices,
                    body.shape.faces,
                    color=GHOST_COLORS[layout],
                    **_GHOST,
                    **_pose_arguments(poses[body.name]),
                )
                for number, body in enumerate(self._bodies)
                if body.name in poses and len(body.shape.faces)
            ]
        for name, handles in self._ghosts.items():
            for handle in handles:
                handle.visible = name == layout

    def show_contacts(self, contacts: Contacts | None) -> None:
        """Show an arrow per contact along its normal, its length by the force; None hides them."""
        if self._contacts is not None:
            self._contacts.remove()
            self._contacts = None
        if contacts is not None and len(contacts):
            arrows = contacts.compute_arrows()
            self._contacts = self._client.scene.add_arrows("/contacts", arrows, CONTACT_COLOR, **_ARROW)

    def show_arm(self, motion: MotionPlayback | None) -> None:
        """Show the arm of a motion, or none."""
        for handle in self._arm:
            handle.remove()
        self._arm = []
        if motion is not None:
            meshes = [encode_visuals([VisualMesh(mesh, _ARM_COLOR)]) for mesh in (*motion.meshes, motion.pedestal)]
            self._arm = [self._client.scene.add_glb(f"/arm/{k}", data) for k, data in enumerate(meshes)]

    def set_arm_poses(self, poses: Sequence[Pose]) -> None:
        """Set the poses of the parts of the arm; the pedestal does not move."""
        with self._client.atomic():
            for handle, pose in zip(self._arm, (*poses, identity_pose()), strict=True):
                _set_pose(handle, pose)

    def set_camera(self, orbit_camera: OrbitCamera) -> None:
        """Move the camera."""
        camera = self._client.camera
        self._orbit_camera, self._aspect = orbit_camera, camera.aspect
        with self._client.atomic():
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.position = orbit_camera.position
            camera.look_at = orbit_camera.target
            camera.fov = orbit_camera.field_of_view(camera.aspect)

    def _on_camera_update(self, camera: Any) -> None:
        """Keep the whole picture in view after a change of the aspect."""
        if self._orbit_camera is not None and abs(camera.aspect - self._aspect) > 1e-3:
            self._aspect = camera.aspect
            camera.fov = self._orbit_camera.field_of_view(camera.aspect)


def _pose_arguments(pose: Pose) -> dict[str, np.ndarray]:
    return {"position": np.array(pose.position), "wxyz": np.array(pose.quaternion_wxyz)}


def _set_pose(handle: Any, pose: Pose) -> None:
    handle.position, handle.wxyz = pose.position, pose.quaternion_wxyz
