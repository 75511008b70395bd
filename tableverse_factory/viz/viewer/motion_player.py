"""Trajectory playback of one browser: choice of a task, play, pause, seek."""

from collections.abc import Mapping, Sequence
from typing import Any

from tableverse_factory.core.text import sanitize_line
from tableverse_factory.viz.viewer.canvas import Canvas
from tableverse_factory.viz.viewer.layouts import Poses
from tableverse_factory.viz.viewer.loaded_scene import LoadedScene, merge_poses
from tableverse_factory.viz.viewer.motion_playback import MotionPlayback, describe_outcome
from tableverse_factory.viz.viewer.panel import NO_TASK, Panel
from tableverse_factory.viz.viewer.panel_html import format_status

MAX_TASKS = 100

Row = Mapping[str, Any]


class Playhead:
    """A position `time_s` between the start and the end of a recording [s]."""

    def __init__(self, duration_s: float) -> None:
        self.duration_s = max(0.0, duration_s)
        self.time_s = 0.0
        self.playing = False

    def play(self) -> None:
        """Play on, from the end once more from the start."""
        if self.time_s >= self.duration_s:
            self.time_s = 0.0
        self.playing = True

    def pause(self) -> None:
        """Stop playing."""
        self.playing = False

    def seek(self, time_s: float) -> None:
        """Move to a position, clamped to the recording."""
        self.time_s = min(max(time_s, 0.0), self.duration_s)

    def advance(self, seconds: float) -> None:
        """Advance while playing; stop at the end."""
        if self.playing:
            self.seek(self.time_s + seconds)
            self.playing = self.time_s < self.duration_s


class MotionPlayer:
    """The motion of the chosen task and the position in it.

    The task is kept here: viser writes a new choice into the control at any time, in a thread of its own.
    """

    def __init__(self, panel: Panel, canvas: Canvas, robot: str | None) -> None:
        self._panel, self._canvas, self._robot = panel, canvas, robot
        self._rows: dict[str, Row] = {}
        self._row: Row | None = None
        self._motion: MotionPlayback | None = None
        self._playhead = Playhead(0.0)

    @property
    def shown(self) -> bool:
        """Whether a motion is shown."""
        return self._motion is not None

    @property
    def playing(self) -> bool:
        """Whether the motion plays."""
        return self._playhead.playing

    @property
    def duration_s(self) -> float:
        """Duration of the shown motion [s]; 0 without one."""
        return self._playhead.duration_s

    def close(self) -> None:
        """Remove the motion and all rows; the closed canvas has removed the arm."""
        self._row, self._motion, self._playhead = None, None, Playhead(0.0)
        self.set_rows(())

    def set_rows(self, rows: Sequence[Row]) -> None:
        """Offer the trajectories of a scene, rows of trajectories/."""
        self._rows = {str(row["task_id"]): row for row in rows[:MAX_TASKS]}
        self._panel.task.options = [NO_TASK, *map(_format_option, self._rows.values())]
        self._panel.task.value = NO_TASK
        self._show_status()

    def select(self, loaded: LoadedScene) -> None:
        """Show the motion of the chosen task, if it has one; the first one moves the camera to the arm."""
        chosen = self._panel.task.value.partition(" ")[0]  # once: the next choice may come at any time
        first = self._motion is None
        self._remove()
        self._row = self._rows.get(chosen)
        self._show_status()
        if self._row is None or self._row["arrays"] is None:
            return
        motion = loaded.motion(str(self._row["task_id"]), self._robot)
        self._canvas.show_arm(motion)
        self._motion, self._playhead = motion, Playhead(motion.duration_s)
        self._panel.time.max = max(motion.duration_s, motion.step_s)
        self._panel.time.value = 0.0
        if first:
            self.frame_arm()

    def deselect(self) -> None:
        """Remove the motion and the choice."""
        if self._row is not None:
            self._remove()
            self._panel.task.value = NO_TASK
            self._show_status()

    def frame_arm(self) -> None:
        """Move the camera to see the whole arm."""
        if self._motion is not None:
            self._canvas.set_camera(self._motion.viewpoint)

    def play(self) -> None:
        """Play on."""
        if self._motion is not None:
            self._playhead.play()

    def pause(self) -> None:
        """Stop playing."""
        self._playhead.pause()

    def seek_to_slider(self) -> None:
        """Pause at the time of the slider."""
        self._playhead.pause()
        self._playhead.seek(self._panel.time.value)

    def advance(self, seconds: float) -> None:
        """Advance by a time [s]."""
        self._playhead.advance(seconds)
        self._panel.time.value = round(self._playhead.time_s, 2)

    def poses(self, settled: Poses) -> Poses:
        """Return the poses of the objects; those that the motion does not move keep their settled poses."""
        if self._motion is None:
            return settled
        return merge_poses(settled, self._motion.object_poses(self._motion.sample_at(self._playhead.time_s)))

    def show(self) -> None:
        """Draw the arm at the current time and show the phase."""
        if self._motion is not None:
            sample = self._motion.sample_at(self._playhead.time_s)
            self._canvas.set_arm_poses(self._motion.arm_poses(sample))
            self._show_status(f"phase: {self._motion.phase(sample)}")

    def _remove(self) -> None:
        if self._motion is not None:
            self._canvas.show_arm(None)
        self._row, self._motion, self._playhead = None, None, Playhead(0.0)

    def _show_status(self, *more: str) -> None:
        line = describe_outcome(self._row) if self._row is not None else f"{len(self._rows)} tasks were tried"
        self._panel.motion_status.content = format_status(line, *more)


def _format_option(row: Row) -> str:
    mark = "✓" if row["success"] else "✗"
    return f"{row['task_id']} {mark} {sanitize_line(str(row['instruction'] or ''), 80)}"
