"""Playback of a recorded trajectory: poses of the arm and the objects over time, and its outcome."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from schemas.geometry import Pose, TriangleMesh
from schemas.trajectories import Phase
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.delivery.episodes.actors import ArmMeshes
from tableverse_factory.delivery.episodes.cameras import place_film_camera
from tableverse_factory.delivery.episodes.robot import load_recorded_arm
from tableverse_factory.geometry.math.transforms import normalize_quaternion
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.viz.gallery.formatting import format_code, format_phase
from tableverse_factory.viz.viewer.orbit_camera import OrbitCamera, make_orbit_camera

_VIEW_PX = 640, 480
_PHASES = tuple(Phase)


class MotionPlayback:
    """A recording and the arm that executed it."""

    def __init__(self, recording: Recording, x_id: str, robot: str | None = None) -> None:
        """Build the meshes of the arm; `x_id` is the moved object, `robot` the arm as `load_recorded_arm` takes it."""
        self._recording, self._x_id = recording, x_id
        self._arm = ArmMeshes(load_recorded_arm(recording, robot))

    @property
    def duration_s(self) -> float:
        """Time from the first sample to the last [s]."""
        return float(self._recording.time_s[-1] - self._recording.time_s[0])

    @property
    def step_s(self) -> float:
        """Time between samples [s]."""
        return self._recording.step_s

    @property
    def meshes(self) -> tuple[TriangleMesh, ...]:
        """Meshes of the parts of the arm, each in its own frame."""
        return self._arm.meshes

    @property
    def pedestal(self) -> TriangleMesh:
        """Mesh of the pedestal in the table frame."""
        return self._arm.pedestal(self._recording.base)

    @property
    def viewpoint(self) -> OrbitCamera:
        """Camera that sees the whole arm during the whole motion."""
        return make_orbit_camera(place_film_camera(self._recording, self._arm, *_VIEW_PX))

    def sample_at(self, time_s: float) -> int:
        """Find the sample nearest to a time since the start."""
        nearest = round(time_s / self._recording.step_s)
        return min(max(nearest, 0), len(self._recording) - 1)

    def arm_poses(self, sample: int) -> Sequence[Pose]:
        """Compute the poses of the parts of the arm in the table frame."""
        return self._arm.poses(self._recording.qpos[sample].astype(np.float64), self._recording.base)

    def object_poses(self, sample: int) -> dict[str, Pose]:
        """Return the poses of the objects that move; all others keep their settled poses."""
        recording = self._recording
        poses = {self._x_id: _parse_pose(recording.object_pose[sample])}
        for name in recording.moved_ids:
            track = recording.poses_of(name)
            if track is not None:
                poses[name] = _parse_pose(track[sample])
        return poses

    def phase(self, sample: int) -> str:
        """Return the name of the phase."""
        return format_phase(_PHASES[int(self._recording.phase[sample])].value)


def describe_outcome(row: Mapping[str, Any]) -> str:
    """Describe the outcome of a task in one line: success, or phase, reason and the decisive values."""
    if row["success"]:
        return "success"
    where = f" in {format_phase(str(row['failed_phase']))}" if row["failed_phase"] else ""
    why = format_code(sanitize_line(str(row["reason"] or "no reason given"), 80))
    detail = f" ({sanitize_line(str(row['detail']), 300)})" if row["detail"] else ""
    return f"failed{where}: {why}{detail}"


def _parse_pose(numbers: np.ndarray) -> Pose:
    values = numbers.astype(np.float64)
    return Pose(values[:3], normalize_quaternion(values[3:]))
