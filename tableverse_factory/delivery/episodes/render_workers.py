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
from tableverse_factory.delivery.episodes.frames import build_columns
from tableverse_factory.delivery.episodes.robot import load_recorded_arm
from tableverse_factory.delivery.episodes.selection import Episode, EpisodeKind, check_kind, open_episode
from tableverse_factory.delivery.episodes.statistics import FeatureStats, compute_picture_stats
from tableverse_factory.delivery.episodes.video import encode_mp4
from tableverse_factory.geometry.math.camera import PosedCamera

ROBOT_CAMERA, SCENE_CAMERA = "observation.images.robot", "observation.images.scene"


@dataclass(frozen=True, slots=True)
class RenderSetting:
    """Setting shared by all episodes of an export."""

    kind: EpisodeKind
    cameras: tuple[str, ...]  # keys of the videos: `ROBOT_CAMERA`, `SCENE_CAMERA`
    width: int  # [px]
    height: int  # [px]
    every: int  # samples per frame
    fps: int
    object_rows: int  # of `observation.environment_state`, zeros behind those of the scene
    robot: str | None = None  # the user's, for recordings from elsewhere (`load_recorded_arm`)


@dataclass(frozen=True, slots=True)
class RenderedEpisode:
    """Columns of an episode (`frames.build_columns`), and an MP4 and statistics of pictures for each camera."""

    values: dict[str, np.ndarray]
    videos: dict[str, bytes]
    figures: dict[str, FeatureStats]


def render_episodes(
    path: str, setting: RenderSetting, rows: Sequence[Mapping[str, Any]], jobs: int
) -> Iterator[RenderedEpisode]:
    """Render an episode for each row, in order."""
    return parallel_map(partial(render_episode, path, setting), rows, jobs, "draws episodes")


def render_episode(path: str, setting: RenderSetting, row: Mapping[str, Any]) -> RenderedEpisode:
    """Render the episode of a row of trajectories/."""
    episode = open_episode(open_dataset(path), row)
    check_kind(setting.kind, episode)
    samples = list(range(0, len(episode.recording), setting.every))
    arm = load_recorded_arm(episode.recording, setting.robot)
    figure = ArmMeshes(arm)
    videos, figures = {}, {}
    for key in setting.cameras:
        eye = choose_camera(key, episode, setting.width, setting.height)
        pictures = list(render_frames(episode.scene, row["x_id"], episode.recording, figure, eye, samples))
        videos[key] = encode_mp4(pictures, setting.fps)
        figures[key] = compute_picture_stats(pictures)
    values = build_columns(episode, arm, samples, setting.fps, setting.object_rows)
    return RenderedEpisode(values, videos, figures)


def choose_camera(key: str, episode: Episode, width: int, height: int) -> PosedCamera:
    """Place the camera of a video key; InputError `no_camera` if the scene has none."""
    if key == ROBOT_CAMERA:
        return place_robot_camera(episode.recording.base, width, height)
    eye = load_scene_camera(episode.scene.meta, width, height)
    if eye is None:
        raise InputError(f"scene {episode.scene.scene_id} was made without a camera: leave out `scene`", "no_camera")
    return eye
