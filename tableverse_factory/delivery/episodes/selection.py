"""Selection of trajectories for export, and checks of what they must share."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from schemas.geometry import Frozen
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Dataset, Scene
from tableverse_factory.dataset.trajectory_files import check_digest
from tableverse_factory.robotics.execution.arrays import Recording, decode_recording


@dataclass(frozen=True, slots=True, eq=False)
class Episode(Frozen):
    """Recorded trajectory, with its row of trajectories/ and its scene."""

    row: Mapping[str, Any]
    scene: Scene
    recording: Recording

    @property
    def name(self) -> str:
        """Name in messages."""
        return f"scene {self.scene.scene_id}, {self.row['task_id']}"


def select_rows(dataset: Dataset, failed: bool) -> list[dict[str, Any]]:
    """Select rows of trajectories with arrays, by scene and task; failures only if asked for."""
    rows = [row for row in dataset.trajectories.to_table().to_pylist() if row["arrays"]]
    kept = [row for row in rows if failed or row["success"]]
    if not kept:
        lost = f"{len(rows)} of its trajectories failed; --failed takes those" if rows else "it has no trajectories"
        raise InputError(f"{dataset.path}: nothing to export: {lost}", "no_trajectories")
    return sorted(kept, key=lambda row: (row["scene_id"], row["task_id"]))


def open_episode(dataset: Dataset, row: Mapping[str, Any]) -> Episode:
    """Open the episode of a row."""
    scene = dataset.scene(row["scene_id"])
    return Episode(row, scene, load_recording(scene, row))


def load_recording(scene: Scene, row: Mapping[str, Any]) -> Recording:
    """Load the arrays that a row of trajectories/ names."""
    name, data = str(row["arrays"]), scene.files().get(str(row["arrays"]))
    if data is None:
        raise InputError(f"scene {scene.scene_id} has no {sanitize_line(name, 100)}", "bad_arrays")
    try:
        return decode_recording(check_digest(data, row), sanitize_line(name, 100))
    except InputError as error:
        raise InputError(f"scene {scene.scene_id}, {error}", "bad_arrays") from None


@dataclass(frozen=True, slots=True)
class EpisodeKind:
    """Properties that learners need to be the same in all episodes; `episode` names one in messages."""

    robot: str
    step_s: float
    n_commands: int
    episode: str


def get_kind(episode: Episode) -> EpisodeKind:
    """Get the kind of one episode."""
    recording = episode.recording
    return EpisodeKind(recording.robot, recording.step_s, recording.command.shape[1], episode.name)


def check_kind(first: EpisodeKind, episode: Episode) -> None:
    """Check that an episode has the robot and step of the first one."""
    other = get_kind(episode)
    if replace(other, episode=first.episode) != first:
        raise InputError(
            f"{other.episode} is of {sanitize_line(other.robot, 80)} every {other.step_s} s, {first.episode} of "
            f"{sanitize_line(first.robot, 80)} every {first.step_s} s: one export has one robot and one step",
            "mixed_episodes",
        )


def check_new_path(dest: Path) -> None:
    """Refuse an existing path."""
    if dest.exists() or dest.is_symlink():
        raise InputError(f"{dest}: already there; give a new name", "dest_exists")
