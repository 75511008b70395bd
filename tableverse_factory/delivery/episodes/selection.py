"""The trajectories of a dataset that are exported, and what has to be the same in all of them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from schemas.geometry import Frozen
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Dataset, Scene
from tableverse_factory.dataset.trajectory_files import intact
from tableverse_factory.robotics.execution.arrays import Recording, read_arrays

_MAX_INSTRUCTION = 500


@dataclass(frozen=True, slots=True, eq=False)
class Episode(Frozen):
    """One recorded trajectory.

    Attributes:
        row: Of trajectories/.
        scene: Opened.
        recording: What was commanded and what happened.
    """

    row: Mapping[str, Any]
    scene: Scene
    recording: Recording

    @property
    def name(self) -> str:
        """For messages."""
        return f"scene {self.scene.scene_id}, {self.row['task_id']}"


def selected_rows(dataset: Dataset, failed: bool) -> list[dict[str, Any]]:
    """Rows of trajectories with arrays, by scene and task; failures only where they are wanted.

    Raises:
        InputError: `no_trajectories` if there is none, saying how many failed.
    """
    rows = [row for row in dataset.trajectories.to_table().to_pylist() if row["arrays"]]
    kept = [row for row in rows if failed or row["success"]]
    if not kept:
        lost = f"{len(rows)} of its trajectories failed; --failed takes those" if rows else "it has no trajectories"
        raise InputError(f"{dataset.path}: nothing to export: {lost}", "no_trajectories")
    return sorted(kept, key=lambda row: (row["scene_id"], row["task_id"]))


def instruction_of(row: Mapping[str, Any]) -> str:
    """The sentence of the task: foreign text, cut and without control characters."""
    return sanitize_line(str(row["instruction"] or ""), _MAX_INSTRUCTION)


def open_episode(dataset: Dataset, row: Mapping[str, Any]) -> Episode:
    """The episode of a row.

    Raises:
        InputError: if the scene does not open, or its arrays are missing or none.
    """
    scene = dataset.scene(row["scene_id"])
    return Episode(row, scene, recording_of(scene, row))


def recording_of(scene: Scene, row: Mapping[str, Any]) -> Recording:
    """The arrays that a row of trajectories/ names.

    Raises:
        InputError: `bad_arrays` if the scene lacks that file, it is none, or not the one that was written.
    """
    name, data = str(row["arrays"]), scene.files().get(str(row["arrays"]))
    if data is None:
        raise InputError(f"scene {scene.scene_id} has no {sanitize_line(name, 100)}", "bad_arrays")
    try:
        return read_arrays(intact(data, row), sanitize_line(name, 100))
    except InputError as error:
        raise InputError(f"scene {scene.scene_id}, {error}", "bad_arrays") from None


def open_episodes(dataset: Dataset, rows: Sequence[Mapping[str, Any]]) -> Iterator[Episode]:
    """The episodes of sorted rows, one at a time; every scene is read once."""
    scene: Scene | None = None
    for row in rows:
        if scene is None or scene.scene_id != row["scene_id"]:
            scene = dataset.scene(row["scene_id"])
        yield Episode(row, scene, recording_of(scene, row))


@dataclass(frozen=True, slots=True)
class EpisodeKind:
    """What learners need to be the same in all episodes.

    Attributes:
        robot: Name of the arm.
        step_s: Time between samples [s].
        n_commands: Joints, and the gripper.
        episode: Whose kind it is, for messages.
    """

    robot: str
    step_s: float
    n_commands: int
    episode: str


def kind_of(episode: Episode) -> EpisodeKind:
    """Of one episode."""
    recording = episode.recording
    return EpisodeKind(recording.robot, recording.step_s, recording.command.shape[1], episode.name)


def check_kind(first: EpisodeKind, episode: Episode) -> None:
    """One robot, one rhythm.

    Raises:
        InputError: `mixed_episodes` if an episode is of another kind than the first one.
    """
    other = kind_of(episode)
    if replace(other, episode=first.episode) != first:
        raise InputError(
            f"{other.episode} is of {sanitize_line(other.robot, 80)} every {other.step_s} s, {first.episode} of "
            f"{sanitize_line(first.robot, 80)} every {first.step_s} s: episodes of one export have one robot and one step",
            "mixed_episodes",
        )


def check_new(dest: Path) -> None:
    """Refuses a place where something is.

    Raises:
        InputError: `dest_exists`.
    """
    if dest.exists() or dest.is_symlink():
        raise InputError(f"{dest}: already there; give a new name", "dest_exists")
