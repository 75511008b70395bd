"""Parallel rendering of episodes in worker processes, returned in order."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.delivery.episodes.actors import ArmMeshes
from tableverse_factory.delivery.episodes.cameras import load_scene_camera, place_robot_camera
from tableverse_factory.delivery.episodes.film import render_frames
from tableverse_factory.delivery.episodes.frames import build_columns, frame_samples
from tableverse_factory.delivery.episodes.robot import load_recorded_arm
from tableverse_factory.delivery.episodes.selection import Episode, EpisodeKind, check_kind, open_episode
from tableverse_factory.delivery.episodes.statistics import FeatureStats, compute_picture_stats
from tableverse_factory.delivery.episodes.video import encode_mp4
from tableverse_factory.geometry.math.camera import PosedCamera

ROBOT_CAMERA, SCENE_CAMERA = "observation.images.robot", "observation.images.scene"


@dataclass(frozen=True, slots=True)
class RenderSetting:
    """Setting shared by all episodes of an export.

    Attributes:
        kind: Robot and step of all episodes.
        cameras: Keys of the videos: `ROBOT_CAMERA`, `SCENE_CAMERA`.
        width: Of the pictures [px].
        height: Of the pictures [px].
        every: Samples per frame.
        fps: Frames per second.
        robot: User-given arm of recordings from elsewhere (`load_recorded_arm`).
    """

    kind: EpisodeKind
    cameras: tuple[str, ...]
    width: int
    height: int
    every: int
    fps: int
    robot: str | None = None


@dataclass(frozen=True, slots=True)
class RenderedEpisode:
    """Rendered episode.

    Attributes:
        values: Its columns (`frames.build_columns`).
        videos: An MP4 for each camera.
        figures: Statistics of each camera's pictures.
    """

    values: dict[str, np.ndarray]
    videos: dict[str, bytes]
    figures: dict[str, FeatureStats]


def render_episodes(
    path: str, setting: RenderSetting, rows: Sequence[Mapping[str, Any]], jobs: int
) -> Iterator[RenderedEpisode]:
    """Render an episode for each row, in order.

    Raises:
        InputError: if an episode does not open, is unlike the first, or a process died.
    """
    return parallel_map(partial(render_episode, path, setting), rows, jobs, "draws episodes")


def render_episode(path: str, setting: RenderSetting, row: Mapping[str, Any]) -> RenderedEpisode:
    """Render the episode of a row of trajectories/."""
    episode = open_episode(open_dataset(path), row)
    check_kind(setting.kind, episode)
    samples = frame_samples(episode.recording, setting.every)
    figure = ArmMeshes(load_recorded_arm(episode.recording, setting.robot))
    videos, figures = {}, {}
    for key in setting.cameras:
        eye = choose_camera(key, episode, setting.width, setting.height)
        pictures = list(render_frames(episode.scene, row["x_id"], episode.recording, figure, eye, samples))
        videos[key] = encode_mp4(pictures, setting.fps)
        figures[key] = compute_picture_stats(pictures)
    return RenderedEpisode(
        build_columns(episode.recording, samples, setting.fps, bool(row["success"])), videos, figures
    )


def choose_camera(key: str, episode: Episode, width: int, height: int) -> PosedCamera:
    """Place the camera of a video key.

    Raises:
        InputError: `no_camera` if the scene has none.
    """
    if key == ROBOT_CAMERA:
        return place_robot_camera(episode.recording.base, width, height)
    eye = load_scene_camera(episode.scene.meta, width, height)
    if eye is None:
        raise InputError(f"scene {episode.scene.scene_id} was made without a camera: leave out `scene`", "no_camera")
    return eye
