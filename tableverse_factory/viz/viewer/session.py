"""The session of one browser: its scene, camera, controls and physics, independent of other browsers."""

from collections.abc import Callable
from typing import Any

from tableverse_factory.core.text import sanitize_line
from tableverse_factory.sources.textures.catalogue import FAMILIES
from tableverse_factory.viz.viewer.canvas import Canvas
from tableverse_factory.viz.viewer.layouts import LAYOUTS, SETTLED, Poses
from tableverse_factory.viz.viewer.loaded_scene import LoadedScene
from tableverse_factory.viz.viewer.motion_player import MotionPlayer
from tableverse_factory.viz.viewer.panel import AS_EXPORTED, NO_GHOST, NO_MATCH, PAUSE, PLAY, Panel
from tableverse_factory.viz.viewer.panel_html import (
    format_dropped_scene,
    format_facts,
    format_photograph,
    format_status,
)
from tableverse_factory.viz.viewer.physics_player import PhysicsPlayer
from tableverse_factory.viz.viewer.scene_cache import Row, SceneCache
from tableverse_factory.viz.viewer.scene_list import SceneList
from tableverse_factory.viz.viewer.session_lock import SessionLock

_CONTACTS_EVERY = 5  # number of ticks between two drawings of the contacts


class Session:
    """The view and the controls of one client.

    viser writes a new value into a control at any time, in a thread of its own, before the callback runs. An action
    therefore reads a value once, and the state that depends on it is kept here.
    """

    def __init__(
        self, client: Any, scenes: SceneCache, robot: str | None, link: Callable[[str], str], wake: Callable[[], None]
    ) -> None:
        """Build the controls in the browser of a `viser.ClientHandle`.

        `robot` is the arm of trajectories whose robot comes from a file; `link` makes the address of a scene, empty if
        it has none; `wake` is called when playback starts.
        """
        self._client, self._scenes, self._link, self._wake = client, scenes, link, wake
        self._lock = SessionLock(client, self._halt)
        self._canvas, self._panel = Canvas(client), Panel(client.gui)
        self._list = SceneList(self._panel, scenes)
        self._motion = MotionPlayer(self._panel, self._canvas, robot)
        self._physics = PhysicsPlayer(self._panel)
        self._scene_id = ""
        self._loaded: LoadedScene | None = None
        self._names: dict[str, str] = {}
        self._ticks = 0
        self._connect_controls()

    @property
    def playing(self) -> bool:
        """Whether physics or a motion plays."""
        return self._physics.running or self._motion.playing

    @property
    def simulated_s(self) -> float:
        """Simulated time since the last reset [s]."""
        return self._physics.time_s

    @property
    def duration_s(self) -> float:
        """Duration of the shown motion [s]; 0 without one."""
        return self._motion.duration_s

    def open(self, scene_id: str | None) -> None:
        """Show a scene, or the reason why it has none."""
        self._lock.run(lambda: self._open(scene_id))

    def tick(self, seconds: float, budget_s: float) -> None:
        """Advance playback by some seconds, unless another action runs: other sessions wait for their tick."""
        self._lock.try_run(lambda: self._tick(seconds, budget_s))

    def _connect_controls(self) -> None:
        panel = self._panel
        for action, *controls in (
            (self._search, panel.search, panel.status),
            (lambda: self._open(panel.scene.value), panel.scene),
            (self._show, panel.looks, panel.pieces, panel.contacts, panel.names, panel.ghosts),
            (self._reset_layout, panel.layout),
            (self._change_texture, panel.texture, panel.texture_number),
            (self._choose_task, panel.task),
            (self._scrub, panel.time),
        ):
            for control in controls:
                control.on_update(self._lock.make_callback(action))
        for button, action in (
            (panel.camera, self._reset_camera),
            (panel.step, self._step),
            (panel.run, self._run),
            (panel.push, self._push),
            (panel.play, self._play),
            (panel.whole_arm, self._motion.frame_arm),
        ):
            button.on_click(self._lock.make_callback(action))

    # Scene

    def _search(self) -> None:
        other = self._list.search(self._scene_id)
        if other is not None:
            self._open(other)
        else:
            self._list.show(self._scene_id)

    def _step(self) -> None:
        other = self._list.step(self._scene_id)
        if other is not None:
            self._open(other)

    def _open(self, scene_id: str | None) -> None:
        if scene_id is None or scene_id == NO_MATCH:
            self._list.show(self._scene_id)
            return
        self._scene_id, self._loaded, self._names = scene_id, None, {}
        self._canvas.close()
        self._physics.close()
        self._motion.close()
        self._list.show(scene_id)  # first: from a scene that does not open, the next can be chosen
        self._panel.photograph.content = self._panel.facts.content = ""
        dropped = self._scenes.find_dropped_row(scene_id)
        if dropped is not None:
            self._panel.facts.content = format_dropped_scene(dropped)
            return
        loaded = self._scenes.open(scene_id)
        with self._client.atomic():
            self._canvas.open(loaded)
        self._loaded = loaded
        self._describe(loaded)
        self._reset_camera()
        self._show()
        self._motion.set_rows(loaded.scene.trajectory_rows())
        self._panel.photograph.content = format_photograph(loaded.photograph)  # last: it may be damaged

    def _describe(self, loaded: LoadedScene) -> None:
        panel, objects = self._panel, loaded.object_rows
        self._names = {str(row["object_id"]): _format_name(row) for row in objects}
        self._physics.open(loaded, self._names)
        panel.camera.show_names = "Picture's camera" if loaded.has_camera else "View from the front"
        link = self._link(self._scene_id)
        panel.facts.content = format_facts(loaded.scene.row, loaded.meta, objects, loaded.scene.task_rows(), link)
        layouts = [name for name in LAYOUTS if name in loaded.layouts]
        panel.layout.options, panel.layout.value = layouts, SETTLED
        panel.ghosts.options, panel.ghosts.value = [NO_GHOST, *layouts], NO_GHOST
        panel.texture.value, panel.texture_number.value = AS_EXPORTED, 0

    # Visibility

    def _reset_camera(self) -> None:
        if self._loaded is not None:
            self._canvas.set_camera(self._loaded.viewpoint)

    def _show(self) -> None:
        loaded, panel = self._loaded, self._panel
        if loaded is None:
            return
        self._canvas.set_visibility(panel.looks.value, panel.pieces.value)
        self._canvas.show_names(self._names, panel.names.value)
        ghosts = panel.ghosts.value
        self._canvas.show_ghost(ghosts if ghosts in loaded.layouts else None, loaded.layouts.get(ghosts, {}))
        self._place()

    def _reset_layout(self) -> None:
        self._halt()
        self._motion.deselect()
        self._physics.reset(self._layout())
        self._place()

    def _layout(self) -> Poses:
        layouts = self._loaded.layouts if self._loaded is not None else {}
        return layouts.get(self._panel.layout.value, layouts.get(SETTLED, {}))

    def _find_fixed_poses(self) -> Poses | None:
        """Return the poses in the motion or in the layout; None after the start of the simulation."""
        if self._loaded is not None and self._motion.shown:
            return self._motion.poses(self._loaded.settled)
        return self._layout() if self._physics.time_s == 0.0 else None

    def _place(self, contacts: bool = True) -> None:
        fixed = self._find_fixed_poses()
        self._canvas.set_poses(self._physics.poses() if fixed is None else fixed)
        self._motion.show()
        if contacts:
            self._show_contacts(fixed)

    def _show_contacts(self, fixed: Poses | None) -> None:
        """Draw the contacts of the shown poses; those of a motion without the arm."""
        if not self._panel.contacts.value or self._loaded is None:
            self._canvas.show_contacts(None)
            self._panel.shown.content = ""
            return
        contacts = self._physics.contacts(fixed)
        self._canvas.show_contacts(contacts)
        self._panel.shown.content = format_status(
            f"{contacts.total} contacts, {contacts.forces_n.sum():.2f} N in all, "
            f"deepest {1000 * max(contacts.depths_m.max(initial=0.0), 0.0):.2f} mm"
        )

    def _change_texture(self) -> None:
        family, loaded = self._panel.texture.value, self._loaded
        if loaded is not None:
            texture = f"{family}-{self._panel.texture_number.value}" if family in FAMILIES else None
            self._canvas.set_static(loaded.retexture_table(texture))

    # Playback

    def _run(self) -> None:
        pressed = self._panel.run.value
        self._halt()
        if self._loaded is None:
            return
        if pressed == PLAY:
            self._simulate()
        elif pressed != PAUSE:
            self._reset_layout()
        self._physics.show_status()

    def _push(self) -> None:
        if self._physics.push():
            self._simulate()

    def _simulate(self) -> None:
        self._motion.deselect()
        self._physics.running = True
        self._wake()

    def _choose_task(self) -> None:
        self._halt()
        if self._loaded is not None:
            self._motion.select(self._loaded)
            self._place()

    def _play(self) -> None:
        pressed = self._panel.play.value
        self._halt()
        if pressed == PLAY:
            self._motion.play()
            self._wake()

    def _scrub(self) -> None:
        self._motion.seek_to_slider()
        self._place()

    def _halt(self) -> None:
        self._physics.running = False
        self._motion.pause()

    def _tick(self, seconds: float, budget_s: float) -> None:
        seconds *= self._panel.speed.value
        self._ticks += 1
        share = 1.0
        if self._motion.playing:
            self._motion.advance(seconds)
        elif self._physics.running:
            share = self._physics.advance(seconds, budget_s)
        due = self._ticks % _CONTACTS_EVERY == 0
        self._place(contacts=due or not self.playing)
        if due and self._physics.running:
            self._physics.show_status(share)


def _format_name(row: Row) -> str:
    return sanitize_line(str(row.get("relabel_name") or row.get("label") or row["object_id"]), 60)
