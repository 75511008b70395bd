"""The trajectories of one scene for the gallery: a film and a plot of each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from PIL import Image

from schemas.identity import check_id
from schemas.trajectories import Phase
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.dataset.trajectory import Trajectory
from tableverse_factory.delivery.episodes.actors import ArmFigure
from tableverse_factory.delivery.episodes.cameras import film_eye
from tableverse_factory.delivery.episodes.film import frames, samples_at, webp_bytes
from tableverse_factory.delivery.episodes.plot import plot_svg
from tableverse_factory.delivery.episodes.robot import recorded_arm

WIDTH, HEIGHT = 320, 240
FPS = 10.0
_JPEG_QUALITY = 82


@dataclass(frozen=True, slots=True)
class MotionCard:
    """What the gallery shows of one trajectory.

    Attributes:
        row: Of trajectories/.
        film: Name of the film and of its still, without their endings; empty where there is none.
        plot: Joints and gripper over time, as markup; None where there is none.
        problem: Why a recording could not be shown.
    """

    row: Mapping[str, Any]
    film: str = ""
    plot: Markup | None = None
    problem: str = ""

    @property
    def id(self) -> str:
        """Of the task: safe as an anchor."""
        return str(self.row["task_id"])


def write_motions(scene: Scene, folder: Path, films: int, robot: str | None = None) -> tuple[MotionCard, ...]:
    """Writes the films of a scene, and returns what to show of each trajectory, in the order of the tasks.

    Args:
        scene: Opened.
        folder: For the films.
        films: At most so many of them are drawn.
        robot: The arm of recordings whose robot is none of ours: a file, or `menagerie:NAME`.

    Raises:
        InputError: if the table of trajectories does not read.
        ValueError: if the id of a task is not safe as a file name.
    """
    filmed = filmed_tasks(scene.trajectory_rows(), films)
    return tuple(
        _motion(scene, each, folder, str(each.row["task_id"]) in filmed, robot) for each in scene.trajectories()
    )


def rows_only(rows: Sequence[Mapping[str, Any]]) -> tuple[MotionCard, ...]:
    """What is told of trajectories without opening their recordings."""
    return tuple(MotionCard(row) for row in rows)


def filmed_tasks(rows: Sequence[Mapping[str, Any]], most: int) -> frozenset[str]:
    """The tasks whose films say most: one of each relation and outcome, then others, in the order of the tasks."""
    seen: set[tuple[str, bool]] = set()
    first: list[str] = []
    later: list[str] = []
    for row in (row for row in rows if row["arrays"] is not None):
        kind = (str(row["relation"]), bool(row["success"]))
        (later if kind in seen else first).append(str(row["task_id"]))
        seen.add(kind)
    return frozenset([*first, *later][:most])


def _motion(scene: Scene, trajectory: Trajectory, folder: Path, filmed: bool, robot: str | None) -> MotionCard:
    row, name = trajectory.row, f"{scene.scene_id}-{check_id(str(trajectory.row['task_id']))}"
    if row["arrays"] is None:
        return MotionCard(row)
    try:
        recording = trajectory.recording()
        arm = recorded_arm(recording, robot)
        plot = Markup(plot_svg(recording, arm.finger_closed, arm.finger_open, arm.max_opening_m))  # noqa: S704
        if not filmed:
            return MotionCard(row, plot=plot)
        figure = ArmFigure(arm)
        samples, eye = samples_at(recording, FPS), film_eye(recording, figure, WIDTH, HEIGHT)
        pictures = list(frames(scene, str(row["x_id"]), recording, figure, eye, samples))
        (folder / f"{name}.webp").write_bytes(webp_bytes(pictures, FPS))
        still = Image.fromarray(np.ascontiguousarray(pictures[_telling(recording.phase[samples])]))
        still.save(folder / f"{name}.jpg", "JPEG", quality=_JPEG_QUALITY, optimize=True)
        return MotionCard(row, name, plot)
    except (InputError, ConfigError, ValueError) as error:
        return MotionCard(row, problem=str(error)[:500])


def _telling(phases: np.ndarray) -> int:
    """The frame that says most: in the middle of the way over, or the last one where it did not come so far."""
    carrying = np.flatnonzero(phases == list(Phase).index(Phase.PRE_PLACE))
    return int(carrying[len(carrying) // 2]) if len(carrying) else len(phases) - 1
