"""Films and plots of the trajectories of one scene."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from PIL import Image

from schemas.identity import check_id
from schemas.trajectories import Phase
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.dataset.trajectory import Trajectory
from tableverse_factory.delivery.episodes.actors import ArmMeshes
from tableverse_factory.delivery.episodes.cameras import place_film_camera
from tableverse_factory.delivery.episodes.film import choose_samples, encode_webp, render_frames
from tableverse_factory.delivery.episodes.plot import plot_svg
from tableverse_factory.delivery.episodes.robot import load_recorded_arm
from tableverse_factory.viz.gallery.pictures import encode_jpeg

WIDTH, HEIGHT = 320, 240
FPS = 10.0
_JPEG_QUALITY = 82


@dataclass(frozen=True, slots=True)
class MotionCard:
    """A trajectory on the page of its scene."""

    row: Mapping[str, Any]
    film: str = ""  # name of the film and of its still without suffix; empty without a film
    plot: Markup | None = None  # joints and gripper over time; None without a plot
    problem: str = ""  # why the recording could not be shown

    @property
    def id(self) -> str:
        """Id of the task, safe as an anchor."""
        return str(self.row["task_id"])


def write_motions(scene: Scene, folder: Path, films: int, robot: str | None = None) -> tuple[MotionCard, ...]:
    """Write at most `films` films and return a card per trajectory, in the order of the tasks."""
    filmed = choose_filmed_tasks(scene.trajectory_rows(), films)
    return tuple(
        _write_motion(scene, each, folder, str(each.row["task_id"]) in filmed, robot) for each in scene.trajectories()
    )


def choose_filmed_tasks(rows: Sequence[Mapping[str, Any]], most: int) -> frozenset[str]:
    """Choose the tasks to film: one of each relation and outcome first, then others, in the order of the tasks."""
    seen: set[tuple[str, bool]] = set()
    first: list[str] = []
    later: list[str] = []
    for row in (row for row in rows if row["arrays"] is not None):
        kind = (str(row["relation"]), bool(row["success"]))
        (later if kind in seen else first).append(str(row["task_id"]))
        seen.add(kind)
    return frozenset([*first, *later][:most])


def name_film(scene_id: str, task_id: object) -> str:
    """Name the film of a trajectory, without suffix."""
    return f"{scene_id}-{task_id}"


def list_film_files(names: Iterable[str]) -> list[str]:
    """List the files of films: each film and its still."""
    return [name + suffix for name in names for suffix in (".webp", ".jpg")]


def _write_motion(scene: Scene, trajectory: Trajectory, folder: Path, filmed: bool, robot: str | None) -> MotionCard:
    row, name = trajectory.row, name_film(scene.scene_id, check_id(str(trajectory.row["task_id"])))
    if row["arrays"] is None:
        return MotionCard(row)
    try:
        recording = trajectory.recording()
        arm = load_recorded_arm(recording, robot)
        plot = Markup(plot_svg(recording, arm.finger_closed, arm.finger_open, arm.max_opening_m))  # noqa: S704
        if not filmed:
            return MotionCard(row, plot=plot)
        arm_meshes = ArmMeshes(arm)
        samples, camera = choose_samples(recording, FPS), place_film_camera(recording, arm_meshes, WIDTH, HEIGHT)
        pictures = list(render_frames(scene, str(row["x_id"]), recording, arm_meshes, camera, samples))
        still = Image.fromarray(np.ascontiguousarray(pictures[_choose_still(recording.phase[samples])]))
        jpeg = encode_jpeg(still, _JPEG_QUALITY)
        for file, data in zip(list_film_files([name]), (encode_webp(pictures, FPS), jpeg), strict=True):
            write_atomic(folder / file, data)
        return MotionCard(row, name, plot)
    except (InputError, ConfigError, ValueError) as error:
        return MotionCard(row, problem=str(error)[:500])


def _choose_still(phases: np.ndarray) -> int:
    """Choose the frame in the middle of the transfer, or the last one if the motion ended earlier."""
    carrying = np.flatnonzero(phases == list(Phase).index(Phase.PRE_PLACE))
    return int(carrying[len(carrying) // 2]) if len(carrying) else len(phases) - 1
