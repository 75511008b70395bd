"""What one browser looks at. Every browser has its own scene, camera, controls and physics; none disturbs another."""

from collections.abc import Callable
from typing import Any

from tableverse_factory.core.text import sanitize_line
from tableverse_factory.sources.textures.catalogue import FAMILIES
from tableverse_factory.viz.viewer.canvas import Canvas
from tableverse_factory.viz.viewer.facts import facts_html, lost_html, photograph_html, said_html
from tableverse_factory.viz.viewer.layouts import LAYOUTS, SETTLED, Poses
from tableverse_factory.viz.viewer.loaded_scene import OpenedScene
from tableverse_factory.viz.viewer.motion_player import MotionPlayer
from tableverse_factory.viz.viewer.panel import AS_EXPORTED, NO_GHOST, NO_MATCH, PAUSE, PLAY, Panel
from tableverse_factory.viz.viewer.physics_player import PhysicsPlayer
from tableverse_factory.viz.viewer.scene_cache import Row, SceneCache
from tableverse_factory.viz.viewer.scene_list import SceneList
from tableverse_factory.viz.viewer.session_lock import Turns

_CONTACTS_EVERY = 5
"""Contacts are drawn anew at every so many steps of what plays."""


class Session:
    """One client's view and controls.

    viser writes what a browser chose into a control at any time, in its own thread, before a callback has its turn: a
    value is read once in a turn, and what hangs on it is kept here.
    """

    def __init__(
        self, client: Any, shelf: SceneCache, robot: str | None, link: Callable[[str], str], wake: Callable[[], None]
    ) -> None:
        """Builds the controls.

        Args:
            client: A `viser.ClientHandle`.
            shelf: The scenes.
            robot: The arm of motions whose robot comes from a file.
            link: Makes the address of a scene; empty where it has none.
            wake: Called when something begins to play.
        """
        self._client, self._shelf, self._link, self._wake = client, shelf, link, wake
        self._turns = Turns(client, self._halt)
        self._canvas, self._panel = Canvas(client), Panel(client.gui)
        self._list = SceneList(self._panel, shelf)
        self._motion = MotionPlayer(self._panel, self._canvas, robot)
        self._physics = PhysicsPlayer(self._panel)
        self._scene_id = ""
        self._opened: OpenedScene | None = None
        self._names: dict[str, str] = {}
        self._ticks = 0
        self._listen()

    @property
    def playing(self) -> bool:
        """Whether physics or a motion goes on."""
        return self._physics.running or self._motion.playing

    @property
    def simulated_s(self) -> float:
        """Since the objects were last put down [s]."""
        return self._physics.time_s

    @property
    def duration_s(self) -> float:
        """Of the motion that is shown [s]; 0 without one."""
        return self._motion.duration_s

    def open(self, scene_id: str | None) -> None:
        """Shows a scene; of one that was lost, why."""
        self._turns.take(lambda: self._open(scene_id))

    def tick(self, seconds: float, budget_s: float) -> None:
        """Lets time pass in what plays; not while something else is done here, for others wait for their tick.

        Args:
            seconds: Since the last time [s].
            budget_s: To be spent on physics at most [s].
        """
        self._turns.take_if_free(lambda: self._tick(seconds, budget_s))

    def _listen(self) -> None:
        panel = self._panel
        for control, act in (
            (panel.search, self._search),
            (panel.status, self._search),
            (panel.scene, lambda: self._open(panel.scene.value)),
            (panel.looks, self._show),
            (panel.pieces, self._show),
            (panel.contacts, self._show),
            (panel.names, self._show),
            (panel.ghosts, self._show),
            (panel.layout, self._lay_out),
            (panel.texture, self._retexture),
            (panel.texture_number, self._retexture),
            (panel.task, self._choose_task),
            (panel.time, self._scrub),
        ):
            control.on_update(self._turns.of_control(act))
        for button, act in (
            (panel.camera, self._look),
            (panel.step, self._step),
            (panel.run, self._run),
            (panel.push, self._push),
            (panel.play, self._play),
            (panel.whole_arm, self._motion.see_arm),
        ):
            button.on_click(self._turns.of_control(act))

    # Which scene

    def _search(self) -> None:
        other = self._list.search(self._scene_id)
        if other is not None:
            self._open(other)
        else:
            self._list.show(self._scene_id)

    def _step(self) -> None:
        other = self._list.beside(self._scene_id)
        if other is not None:
            self._open(other)

    def _open(self, scene_id: str | None) -> None:
        if scene_id is None or scene_id == NO_MATCH:
            self._list.show(self._scene_id)
            return
        self._scene_id, self._opened, self._names = scene_id, None, {}
        self._canvas.close()
        self._physics.close()
        self._motion.close()
        self._list.show(scene_id)  # first: from a scene that does not open, one goes on to the next
        self._panel.photograph.content = self._panel.facts.content = ""
        lost = self._shelf.lost(scene_id)
        if lost is not None:
            self._panel.facts.content = lost_html(lost)
            return
        opened = self._shelf.open(scene_id)
        with self._client.atomic():
            self._canvas.open(opened)
        self._opened = opened
        self._describe(opened)
        self._look()
        self._show()
        self._motion.offer(opened.motion_rows)
        self._panel.photograph.content = photograph_html(opened.photograph)  # last: a bad one costs nothing else

    def _describe(self, opened: OpenedScene) -> None:
        """Fills the controls with what this scene has."""
        panel, objects = self._panel, opened.object_rows
        self._names = {str(row["object_id"]): _name(row) for row in objects}
        self._physics.open(opened, self._names)
        panel.camera.label = "Picture's camera" if opened.has_camera else "View from the front"
        link = self._link(self._scene_id)
        panel.facts.content = facts_html(opened.scene.row, opened.meta, objects, opened.task_rows, link)
        layouts = [name for name in LAYOUTS if name in opened.layouts]
        panel.layout.options, panel.layout.value = layouts, SETTLED
        panel.ghosts.options, panel.ghosts.value = [NO_GHOST, *layouts], NO_GHOST
        panel.texture.value, panel.texture_number.value = AS_EXPORTED, 0

    # What is shown of it

    def _look(self) -> None:
        if self._opened is not None:
            self._canvas.look_from(self._opened.viewpoint)

    def _show(self) -> None:
        opened, panel = self._opened, self._panel
        if opened is None:
            return
        self._canvas.show(panel.looks.value, panel.pieces.value)
        self._canvas.label(self._names, panel.names.value)
        ghosts = panel.ghosts.value
        self._canvas.ghost(ghosts if ghosts in opened.layouts else None, opened.layouts.get(ghosts, {}))
        self._place()

    def _lay_out(self) -> None:
        self._halt()
        self._motion.leave()
        self._physics.put(self._layout())
        self._place()

    def _layout(self) -> Poses:
        layouts = self._opened.layouts if self._opened is not None else {}
        return layouts.get(self._panel.layout.value, layouts.get(SETTLED, {}))

    def _held(self) -> Poses | None:
        """Where the objects are held: in the motion, or in the layout; None once they were simulated."""
        if self._opened is not None and self._motion.shown:
            return self._motion.poses(self._opened.settled)
        return self._layout() if self._physics.time_s == 0.0 else None

    def _place(self, contacts: bool = True) -> None:
        held = self._held()
        self._canvas.place(self._physics.poses() if held is None else held)
        self._motion.show()
        if contacts:
            self._touch(held)

    def _touch(self, held: Poses | None) -> None:
        """Draws the contacts of what is shown; those of a motion and of a layout without the arm."""
        if not self._panel.contacts.value or self._opened is None:
            self._canvas.touch(None)
            self._panel.shown.content = ""
            return
        contacts = self._physics.contacts(held)
        self._canvas.touch(contacts)
        self._panel.shown.content = said_html(
            f"{contacts.total} contacts, {contacts.forces_n.sum():.2f} N in all, "
            f"deepest {1000 * max(contacts.depths_m.max(initial=0.0), 0.0):.2f} mm"
        )

    def _retexture(self) -> None:
        family, opened = self._panel.texture.value, self._opened
        if opened is not None:
            texture = f"{family}-{self._panel.texture_number.value}" if family in FAMILIES else None
            self._canvas.lay(opened.retextured(texture))

    # What plays

    def _run(self) -> None:
        asked = self._panel.run.value
        self._halt()
        if self._opened is None:
            return
        if asked == PLAY:
            self._simulate()
        elif asked != PAUSE:
            self._motion.leave()
            self._physics.put(self._layout())
            self._place()
        self._physics.say()

    def _push(self) -> None:
        if self._physics.push():
            self._simulate()

    def _simulate(self) -> None:
        self._motion.leave()
        self._physics.running = True
        self._wake()

    def _choose_task(self) -> None:
        self._halt()
        if self._opened is not None:
            self._motion.choose(self._opened)
            self._place()

    def _play(self) -> None:
        asked = self._panel.play.value
        self._halt()
        if asked == PLAY:
            self._motion.play()
            self._wake()

    def _scrub(self) -> None:
        self._motion.scrub()
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
        now = self._ticks % _CONTACTS_EVERY == 0
        self._place(contacts=now or not self.playing)
        if now and self._physics.running:
            self._physics.say(share)


def _name(row: Row) -> str:
    return sanitize_line(str(row.get("relabel_name") or row.get("label") or row["object_id"]), 60)
