"""The recorded motion that one browser looks at: chosen, played, dragged to and fro."""

from collections.abc import Mapping, Sequence
from typing import Any

from tableverse_factory.core.text import sanitize_line
from tableverse_factory.viz.viewer.canvas import Canvas
from tableverse_factory.viz.viewer.facts import said_html
from tableverse_factory.viz.viewer.layouts import Poses
from tableverse_factory.viz.viewer.loaded_scene import OpenedScene, poses_with
from tableverse_factory.viz.viewer.motion import MotionPlayback, outcome
from tableverse_factory.viz.viewer.panel import NO_TASK, Panel
from tableverse_factory.viz.viewer.playhead import Playhead

MAX_TASKS = 100

Row = Mapping[str, Any]


class MotionPlayer:
    """A task's motion and the place in it.

    Which task it is, is kept here: viser writes what a browser chose into the control at any time, in its own thread.
    """

    def __init__(self, panel: Panel, canvas: Canvas, robot: str | None) -> None:
        """Shows none.

        Args:
            panel: The controls.
            canvas: Where the arm is drawn.
            robot: The arm of motions whose robot comes from a file.
        """
        self._panel, self._canvas, self._robot = panel, canvas, robot
        self._rows: dict[str, Row] = {}
        self._row: Row | None = None
        self._motion: MotionPlayback | None = None
        self._playhead = Playhead(0.0)

    @property
    def shown(self) -> bool:
        """Whether there is a motion to play."""
        return self._motion is not None

    @property
    def playing(self) -> bool:
        """Whether it goes on."""
        return self._playhead.playing

    @property
    def duration_s(self) -> float:
        """Of the motion that is shown [s]; 0 without one."""
        return self._playhead.duration_s

    def close(self) -> None:
        """Shows none, and offers none: a canvas that was closed has no arm any more."""
        self._row, self._motion, self._playhead = None, None, Playhead(0.0)
        self.offer(())

    def offer(self, rows: Sequence[Row]) -> None:
        """Offers a scene's motions.

        Args:
            rows: Of trajectories/.
        """
        self._rows = {str(row["task_id"]): row for row in rows[:MAX_TASKS]}
        self._panel.task.options = [NO_TASK, *map(_option, self._rows.values())]
        self._panel.task.value = NO_TASK
        self._say()

    def choose(self, opened: OpenedScene) -> None:
        """Shows the motion of the task that was chosen, if there is one; the first moves the camera to see the arm.

        Raises:
            InputError: if it does not read, or the arm has to be given.
        """
        chosen = self._panel.task.value.partition(" ")[0]  # once: the next choice may come at any time
        first = self._motion is None
        self._put_away()
        self._row = self._rows.get(chosen)
        self._say()
        if self._row is None or self._row["arrays"] is None:
            return
        motion = opened.motion(str(self._row["task_id"]), self._robot)
        self._canvas.staff(motion)
        self._motion, self._playhead = motion, Playhead(motion.duration_s)
        self._panel.time.max = max(motion.duration_s, motion.step_s)
        self._panel.time.value = 0.0
        if first:
            self.see_arm()

    def leave(self) -> None:
        """Shows none."""
        if self._row is not None:
            self._put_away()
            self._panel.task.value = NO_TASK
            self._say()

    def see_arm(self) -> None:
        """Puts the camera to where the whole arm is seen."""
        if self._motion is not None:
            self._canvas.look_from(self._motion.viewpoint)

    def play(self) -> None:
        """Goes on."""
        if self._motion is not None:
            self._playhead.play()

    def pause(self) -> None:
        """Stays where it is."""
        self._playhead.pause()

    def scrub(self) -> None:
        """Goes to the time that the slider says, and stays there."""
        self._playhead.pause()
        self._playhead.seek(self._panel.time.value)

    def advance(self, seconds: float) -> None:
        """Lets time pass [s]."""
        self._playhead.advance(seconds)
        self._panel.time.value = round(self._playhead.time_s, 2)

    def poses(self, settled: Poses) -> Poses:
        """Where the objects are now.

        Args:
            settled: Of those that the motion does not move.
        """
        if self._motion is None:
            return settled
        return poses_with(settled, self._motion.object_poses(self._motion.sample_at(self._playhead.time_s)))

    def show(self) -> None:
        """Draws the arm where it is now, and says the phase."""
        if self._motion is not None:
            sample = self._motion.sample_at(self._playhead.time_s)
            self._canvas.pose_arm(self._motion.arm_poses(sample))
            self._say(f"phase: {self._motion.phase(sample)}")

    def _put_away(self) -> None:
        if self._motion is not None:
            self._canvas.staff(None)
        self._row, self._motion, self._playhead = None, None, Playhead(0.0)

    def _say(self, *more: str) -> None:
        said = outcome(self._row) if self._row is not None else f"{len(self._rows)} tasks were tried"
        self._panel.motion_said.content = said_html(said, *more)


def _option(row: Row) -> str:
    mark = "✓" if row["success"] else "✗"
    return f"{row['task_id']} {mark} {sanitize_line(str(row['instruction'] or ''), 80)}"
