"""A recorded trajectory to look at: where the arm and the objects are at any time, and how it ended."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from schemas.geometry import Pose, TriangleMesh
from schemas.trajectories import Phase
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.delivery.episodes.actors import ArmFigure
from tableverse_factory.delivery.episodes.cameras import film_eye
from tableverse_factory.delivery.episodes.robot import recorded_arm
from tableverse_factory.geometry.math.transforms import normalized_quaternion
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.viz.gallery.words import code
from tableverse_factory.viz.gallery.words import phase as phase_words
from tableverse_factory.viz.viewer.viewpoint import Viewpoint, viewpoint_of

_VIEW_PX = 640, 480
_PHASES = tuple(Phase)


class MotionPlayback:
    """A recording and the arm that made it."""

    def __init__(self, recording: Recording, x_id: str, robot: str | None = None) -> None:
        """Makes the arm's meshes.

        Args:
            recording: Its arrays.
            x_id: Object that the task is about.
            robot: The arm, where it comes from a file; as `recorded_arm` takes it.

        Raises:
            InputError: if the arm has to be given or is another one.
            ConfigError: if there is no such arm.
        """
        self._recording, self._x_id = recording, x_id
        self._figure = ArmFigure(recorded_arm(recording, robot))

    @property
    def duration_s(self) -> float:
        """From the first sample to the last [s]."""
        return float(self._recording.time_s[-1] - self._recording.time_s[0])

    @property
    def step_s(self) -> float:
        """Between samples [s]."""
        return self._recording.step_s

    @property
    def meshes(self) -> tuple[TriangleMesh, ...]:
        """The arm's parts, each in its own frame."""
        return self._figure.meshes

    @property
    def pedestal(self) -> TriangleMesh:
        """What the arm stands on, in the table frame."""
        return self._figure.pedestal(self._recording.base)

    @property
    def viewpoint(self) -> Viewpoint:
        """From where the whole arm is seen, in all that it does."""
        return viewpoint_of(film_eye(self._recording, self._figure, *_VIEW_PX))

    def sample_at(self, time_s: float) -> int:
        """The sample nearest to a time since the start."""
        nearest = round(time_s / self._recording.step_s)
        return min(max(nearest, 0), len(self._recording) - 1)

    def arm_poses(self, sample: int) -> Sequence[Pose]:
        """Poses of the arm's parts in the table frame."""
        return self._figure.poses(self._recording.qpos[sample].astype(np.float64), self._recording.base)

    def object_poses(self, sample: int) -> dict[str, Pose]:
        """Of the objects that were seen to move; all others stand as settled."""
        recording = self._recording
        poses = {self._x_id: _pose(recording.object_pose[sample])}
        for name in recording.moved_ids:
            way = recording.poses_of(name)
            if way is not None:
                poses[name] = _pose(way[sample])
        return poses

    def phase(self, sample: int) -> str:
        """The phase's name in words."""
        return phase_words(_PHASES[int(self._recording.phase[sample])].value)


def outcome(row: Mapping[str, Any]) -> str:
    """How a task was tried, in one line: success, or phase, reason and the values that decided."""
    if row["success"]:
        return "success"
    where = f" in {phase_words(str(row['failed_phase']))}" if row["failed_phase"] else ""
    why = code(sanitize_line(str(row["reason"] or "no reason given"), 80))
    detail = f" ({sanitize_line(str(row['detail']), 300)})" if row["detail"] else ""
    return f"failed{where}: {why}{detail}"


def _pose(numbers: np.ndarray) -> Pose:
    values = numbers.astype(np.float64)
    return Pose(values[:3], normalized_quaternion(values[3:]))
