"""What one browser looks at. Every browser has its own scene, camera, controls and physics; none disturbs another."""

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from tableverse_factory.errors import InputError, TableverseError
from tableverse_factory.text import printable
from tableverse_factory.textures.catalogue import FAMILIES
from tableverse_factory.viewer.canvas import Canvas
from tableverse_factory.viewer.facts import facts_html, lost_html, photograph_html, said_html
from tableverse_factory.viewer.layouts import LAYOUTS, SETTLED, Poses
from tableverse_factory.viewer.motion import Motion, outcome
from tableverse_factory.viewer.opened import OpenedScene, poses_with
from tableverse_factory.viewer.panel import (
    AS_EXPORTED,
    BACK,
    NEXT,
    NO_GHOST,
    NO_MATCH,
    NO_TASK,
    PAGE_BACK,
    PAGE_NEXT,
    PAUSE,
    PLAY,
    Panel,
)
from tableverse_factory.viewer.playhead import Playhead
from tableverse_factory.viewer.shelf import Shelf
from tableverse_factory.viewer.simulation import Simulation

PAGE = 50
"""Scenes that the list offers at once."""

MAX_TASKS = 100
MAX_OBJECTS = 200
_PUSHES = {"left": (-1.0, 0.0, 0.0), "right": (1.0, 0.0, 0.0), "away": (0.0, 1.0, 0.0), "up": (0.0, 0.0, 1.0)}
_CONTACTS_EVERY = 5
"""Contacts are drawn anew at every so many steps of what plays."""


class Session:
    """One client's view and controls. What its browser says arrives in threads of viser's; a lock puts it in order."""

    def __init__(
        self, client: Any, shelf: Shelf, robot: str | None, link: Callable[[str], str], wake: Callable[[], None]
    ) -> None:
        """Builds the controls.

        Args:
            client: A `viser.ClientHandle`.
            shelf: The scenes.
            robot: The arm of motions whose robot comes from a file.
            link: Makes the address of a scene; empty where it has none.
            wake: Called when something begins to play.
        """
        self._client, self._shelf, self._robot, self._link, self._wake = client, shelf, robot, link, wake
        self._lock = threading.RLock()
        self._canvas, self._panel = Canvas(client), Panel(client.gui)
        self._found = shelf.search("", self._panel.status.value)
        self._scene_id = ""
        self._opened: OpenedScene | None = None
        self._simulation: Simulation | None = None
        self._motion: Motion | None = None
        self._rows: dict[str, Mapping[str, Any]] = {}
        self._names: dict[str, str] = {}
        self._playhead = Playhead(0.0)
        self._running = False
        self._ticks = 0
        self._listen()

    @property
    def playing(self) -> bool:
        """Whether physics or a motion goes on."""
        return self._running or self._playhead.playing

    @property
    def simulated_s(self) -> float:
        """Since the objects were last put down [s]."""
        return self._simulation.time_s if self._simulation is not None else 0.0

    @property
    def duration_s(self) -> float:
        """Of the motion that is shown [s]; 0 without one."""
        return self._playhead.duration_s if self._motion is not None else 0.0

    def open(self, scene_id: str | None) -> None:
        """Shows a scene; of one that was lost, why."""
        self._do(lambda: self._open(scene_id))

    def tick(self, seconds: float, budget_s: float) -> None:
        """Lets time pass in what plays.

        Args:
            seconds: Since the last time [s].
            budget_s: To be spent on physics at most [s].
        """
        self._do(lambda: self._tick(seconds, budget_s))

    def _do(self, act: Callable[[], None]) -> None:
        """One thing at a time; what goes wrong as was to be expected is told in the page, and nothing goes on."""
        with self._lock:
            try:
                act()
            except (TableverseError, OSError) as error:
                self._halt()
                said = printable(str(error), 500)
                self._client.add_notification("This does not work", said, color="red", auto_close_seconds=20.0)

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
            control.on_update(self._answer(act))
        for button, act in (
            (panel.camera, self._look),
            (panel.step, self._step),
            (panel.run, self._run),
            (panel.push, self._push),
            (panel.play, self._play),
            (panel.whole_arm, self._see_arm),
        ):
            button.on_click(self._answer(act))

    def _answer(self, act: Callable[[], None]) -> Callable[[Any], None]:
        """Of a control: what the browser did counts, what this program writes into a control does not."""

        def answer(event: Any) -> None:
            if event.client is not None:
                self._do(act)

        return answer

    # Which scene

    def _search(self) -> None:
        self._found = self._shelf.search(self._panel.search.value, self._panel.status.value)
        if len(self._found) and self._found.place(self._scene_id) < 0:
            self._open(self._found.beside(self._scene_id, 0))
        else:
            self._list()

    def _step(self) -> None:
        steps = {PAGE_BACK: -PAGE, BACK: -1, NEXT: 1, PAGE_NEXT: PAGE}
        other = self._found.beside(self._scene_id, steps.get(self._panel.step.value, 0))
        if other is not None and other != self._scene_id:
            self._open(other)

    def _list(self) -> None:
        panel, place = self._panel, self._found.place(self._scene_id)
        options = self._found.window(self._scene_id, PAGE) or [NO_MATCH]
        if place < 0 and self._scene_id:
            options = [self._scene_id, *options]
        panel.scene.options = options
        if self._scene_id in options:
            panel.scene.value = self._scene_id
        where = f"{place + 1:,} of " if place >= 0 else ""
        panel.place.content = said_html(f"{where}{len(self._found):,} scenes found, {len(self._shelf):,} in all")

    def _open(self, scene_id: str | None) -> None:
        if scene_id is None or scene_id == NO_MATCH:
            self._list()
            return
        self._halt()
        self._scene_id, self._opened, self._motion, self._simulation = scene_id, None, None, None
        self._list()  # first: from a scene that does not open, one goes on to the next
        self._canvas.close()
        self._panel.photograph.content = self._panel.facts.content = ""
        lost = self._shelf.lost(scene_id)
        if lost is not None:
            self._panel.facts.content = lost_html(lost)
            return
        opened = self._opened = self._shelf.open(scene_id)
        self._simulation = Simulation(opened.model)
        with self._client.atomic():
            self._canvas.open(opened)
        self._describe(opened)
        self._look()
        self._show()

    def _describe(self, opened: OpenedScene) -> None:
        """Fills the controls with what this scene has."""
        panel, objects = self._panel, self._shelf.objects(opened)
        self._names = {
            str(row["object_id"]): printable(str(row.get("relabel_name") or row.get("label") or row["object_id"]), 60)
            for row in objects
        }
        panel.photograph.content = photograph_html(opened.photograph)
        panel.camera.label = "Picture's camera" if opened.has_camera else "View from the front"
        link = self._link(self._scene_id)
        panel.facts.content = facts_html(opened.scene.row, opened.meta, objects, self._shelf.tasks(opened), link)
        layouts = [name for name in LAYOUTS if name in opened.layouts]
        panel.layout.options, panel.layout.value = layouts, SETTLED
        panel.ghosts.options, panel.ghosts.value = [NO_GHOST, *layouts], NO_GHOST
        panel.texture.value, panel.texture_number.value = AS_EXPORTED, 0
        named = [f"{figure.name} {self._names.get(figure.name, '')}" for figure in opened.figures[:MAX_OBJECTS]]
        panel.target.options = named or [NO_MATCH]
        self._rows = {str(row["task_id"]): row for row in opened.motion_rows[:MAX_TASKS]}
        panel.task.options = [NO_TASK, *map(self._task_option, self._rows)]
        panel.task.value = NO_TASK
        self._choose_task()

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
        ghosts = panel.ghosts.value if panel.ghosts.value in opened.layouts else None
        self._canvas.ghost(ghosts, opened.layouts.get(panel.ghosts.value, {}))
        self._place(self._poses())

    def _lay_out(self) -> None:
        self._halt()
        self._leave_motion()
        if self._opened is not None and self._simulation is not None:
            self._simulation.put(self._layout())
            self._place(self._layout())

    def _layout(self) -> Poses:
        layouts = self._opened.layouts if self._opened is not None else {}
        return layouts.get(self._panel.layout.value, layouts.get(SETTLED, {}))

    def _poses(self) -> Poses:
        """Where everything is now: in the motion, in the simulation once it has run, in the layout."""
        if self._opened is None or self._simulation is None:
            return {}
        if self._motion is not None:
            sample = self._motion.sample_at(self._playhead.time_s)
            return poses_with(self._opened.settled, self._motion.object_poses(sample))
        return self._simulation.poses() if self._simulation.time_s > 0.0 else self._layout()

    def _place(self, poses: Poses) -> None:
        self._canvas.place(poses)
        self._touch(poses)

    def _touch(self, poses: Poses) -> None:
        """Draws the contacts of what is shown; those of a motion and of a layout without the arm."""
        if not self._panel.contacts.value or self._opened is None or self._simulation is None:
            self._canvas.touch(None)
            self._panel.shown.content = ""
            return
        state = self._simulation
        if self._motion is not None or state.time_s == 0.0:
            state = Simulation(self._opened.model)
            state.put(poses)
        contacts = state.contacts()
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

    # Physics

    def _run(self) -> None:
        if self._opened is None or self._simulation is None:
            return
        asked = self._panel.run.value
        self._halt()
        if asked == PLAY:
            self._leave_motion()
            self._running = True
            self._wake()
        elif asked != PAUSE:
            self._leave_motion()
            self._simulation.put(self._layout())
            self._place(self._layout())
        self._say_physics(1.0)

    def _push(self) -> None:
        opened, name = self._opened, self._panel.target.value.partition(" ")[0]
        figure = next((each for each in opened.figures if each.name == name), None) if opened is not None else None
        if figure is None or self._simulation is None:
            return
        self._leave_motion()
        self._playhead.pause()
        direction = np.array(_PUSHES.get(self._panel.push.value, (0.0, 0.0, 0.0)))
        self._simulation.push(name, figure.mass_kg * self._panel.strength.value * direction)
        self._running = True
        self._wake()

    def _say_physics(self, share: float) -> None:
        if self._simulation is not None:
            slow = f", {100 * share:.0f} % of the speed asked for" if share < 0.9 else ""
            self._panel.physics_said.content = said_html(f"{self._simulation.time_s:.1f} s simulated{slow}")

    # Motions

    def _task_option(self, task_id: str) -> str:
        row = self._rows[task_id]
        mark = "✓" if row["success"] else "✗"
        return f"{task_id} {mark} {printable(str(row['instruction'] or ''), 80)}"

    def _choose_task(self) -> None:
        self._halt()
        first = self._motion is None
        chosen = self._panel.task.value
        self._leave_motion()
        self._panel.task.value = chosen
        row = self._rows.get(chosen.partition(" ")[0])
        tried = len(self._rows)
        self._panel.motion_said.content = said_html(outcome(row) if row else f"{tried} tasks were tried")
        if row is not None and row["arrays"] is not None and self._opened is not None:
            self._motion = self._opened.motion(str(row["task_id"]), self._robot)
            self._playhead = Playhead(self._motion.duration_s)
            self._panel.time.max = max(self._motion.duration_s, self._motion.step_s)
            self._panel.time.value = 0.0
            self._canvas.staff(self._motion)
            if first:
                self._see_arm()
        self._show_motion()

    def _see_arm(self) -> None:
        if self._motion is not None:
            self._canvas.look_from(self._motion.viewpoint)

    def _leave_motion(self) -> None:
        if self._motion is not None:
            self._motion = None
            self._canvas.staff(None)
            self._panel.task.value = NO_TASK

    def _play(self) -> None:
        asked = self._panel.play.value
        self._halt()
        if asked == PLAY and self._motion is not None:
            self._playhead.play()
            self._wake()

    def _scrub(self) -> None:
        self._playhead.pause()
        self._playhead.seek(self._panel.time.value)
        self._show_motion()

    def _show_motion(self) -> None:
        self._place(self._poses())
        if self._motion is None:
            return
        sample = self._motion.sample_at(self._playhead.time_s)
        self._canvas.pose_arm(self._motion.arm_poses(sample))
        row = self._rows[self._panel.task.value.partition(" ")[0]]
        self._panel.motion_said.content = said_html(outcome(row), f"phase: {self._motion.phase(sample)}")

    # Time

    def _halt(self) -> None:
        self._running = False
        self._playhead.pause()

    def _tick(self, seconds: float, budget_s: float) -> None:
        speed = self._panel.speed.value
        self._ticks += 1
        if self._playhead.playing:
            self._playhead.advance(speed * seconds)
            self._panel.time.value = round(self._playhead.time_s, 2)
            self._show_motion()
        elif self._running and self._simulation is not None:
            passed = self._simulation.advance(speed * seconds, budget_s)
            if self._simulation.unstable:
                raise InputError("the simulation became unstable and was stopped: reset it")
            poses = self._simulation.poses()
            self._canvas.place(poses)
            if self._ticks % _CONTACTS_EVERY == 0:
                self._touch(poses)
                self._say_physics(passed / max(speed * seconds, 1e-9))
