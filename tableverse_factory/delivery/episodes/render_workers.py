"""Episodes drawn in processes of their own, and handed over in order: their numbers, and their videos."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.delivery.episodes.actors import ArmFigure
from tableverse_factory.delivery.episodes.cameras import robot_eye, scene_eye
from tableverse_factory.delivery.episodes.film import frames
from tableverse_factory.delivery.episodes.frames import columns, frame_samples
from tableverse_factory.delivery.episodes.robot import recorded_arm
from tableverse_factory.delivery.episodes.selection import Episode, EpisodeKind, check_kind, open_episode
from tableverse_factory.delivery.episodes.statistics import Figures, picture_figures
from tableverse_factory.delivery.episodes.video import mp4_bytes
from tableverse_factory.physics.render.views import Eye

ROBOT_CAMERA, SCENE_CAMERA = "observation.images.robot", "observation.images.scene"


@dataclass(frozen=True, slots=True)
class RenderSetting:
    """What is the same for all episodes of an export.

    Attributes:
        kind: Robot and step that all must have.
        cameras: Keys of the videos: `ROBOT_CAMERA`, `SCENE_CAMERA`.
        width: Of the pictures [px].
        height: Of the pictures [px].
        every: Samples from one frame to the next.
        fps: Frames per second.
        robot: What the user gave as the arm of recordings that came from elsewhere (`recorded_arm`).
    """

    kind: EpisodeKind
    cameras: tuple[str, ...]
    width: int
    height: int
    every: int
    fps: int
    robot: str | None = None


@dataclass(frozen=True, slots=True)
class Shot:
    """One episode.

    Attributes:
        values: Its columns (`frames.columns`).
        videos: An MP4 for each camera.
        figures: Of each camera's pictures.
    """

    values: dict[str, np.ndarray]
    videos: dict[str, bytes]
    figures: dict[str, Figures]


def shots(path: str, setting: RenderSetting, rows: Sequence[Mapping[str, Any]], jobs: int) -> Iterator[Shot]:
    """An episode for each row, in their order.

    Raises:
        InputError: if an episode does not open, is unlike the first, or a process died.
    """
    return parallel_map(partial(shoot_episode, path, setting), rows, jobs, "draws episodes")


def shoot_episode(path: str, setting: RenderSetting, row: Mapping[str, Any]) -> Shot:
    """The episode of a row of trajectories/."""
    episode = open_episode(open_dataset(path), row)
    check_kind(setting.kind, episode)
    samples = frame_samples(episode.recording, setting.every)
    figure = ArmFigure(recorded_arm(episode.recording, setting.robot))
    videos, figures = {}, {}
    for key in setting.cameras:
        eye = eye_of(key, episode, setting.width, setting.height)
        pictures = list(frames(episode.scene, row["x_id"], episode.recording, figure, eye, samples))
        videos[key] = mp4_bytes(pictures, setting.fps)
        figures[key] = picture_figures(pictures)
    return Shot(columns(episode.recording, samples, setting.fps, bool(row["success"])), videos, figures)


def eye_of(key: str, episode: Episode, width: int, height: int) -> Eye:
    """Where a camera stands.

    Raises:
        InputError: `no_camera` if the scene has none.
    """
    if key == ROBOT_CAMERA:
        return robot_eye(episode.recording.base, width, height)
    eye = scene_eye(episode.scene.meta, width, height)
    if eye is None:
        raise InputError(f"scene {episode.scene.scene_id} was made without a camera: leave out `scene`", "no_camera")
    return eye
