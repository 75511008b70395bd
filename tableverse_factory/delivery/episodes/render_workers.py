"""Parallel rendering of episodes in worker processes, returned in order."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.delivery.episodes.frames import build_columns
from tableverse_factory.delivery.episodes.pictures import take_recorded_pictures
from tableverse_factory.delivery.episodes.robot import load_recorded_arm
from tableverse_factory.delivery.episodes.selection import EpisodeKind, check_kind, open_episode
from tableverse_factory.delivery.episodes.statistics import FeatureStats, compute_picture_stats
from tableverse_factory.delivery.episodes.video import encode_mp4, find_kind

IMAGES = "observation.images."


@dataclass(frozen=True, slots=True)
class RenderSetting:
    """Setting shared by all episodes of an export."""

    kind: EpisodeKind
    pictures: tuple[str, ...]  # names of `pictures.PICTURES`; the videos' keys begin with `IMAGES`
    width: int  # [px]
    height: int  # [px]
    every: int  # samples per frame
    fps: int
    object_rows: int  # of `observation.environment_state`, zeros behind those of the scene
    robot: str | None = None  # the user's, for recordings from elsewhere (`load_recorded_arm`)


@dataclass(frozen=True, slots=True)
class RenderedEpisode:
    """Columns of an episode (`frames.build_columns`), and an MP4 and statistics for each key of pictures."""

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
    size, videos, figures = (setting.height, setting.width), {}, {}
    for name, pictures in take_recorded_pictures(setting.pictures, episode, arm, size, samples).items():
        videos[IMAGES + name] = encode_mp4(pictures, setting.fps, find_kind(name))
        figures[IMAGES + name] = compute_picture_stats(pictures)
    values = build_columns(episode, arm, samples, setting.fps, setting.object_rows)
    return RenderedEpisode(values, videos, figures)
