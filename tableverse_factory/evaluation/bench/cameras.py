"""CPU time of the pictures that policies see, on recorded motions."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.delivery.episodes.pictures import DEPTH, INSTANCES, iterate_recorded_pictures
from tableverse_factory.delivery.episodes.robot import load_recorded_arm
from tableverse_factory.delivery.episodes.selection import open_episode, select_rows
from tableverse_factory.evaluation.bench.measurement import sample_evenly

CAMERA_SETS = {
    "front": ("front",),
    "wrist": ("wrist",),
    "front and wrist": ("front", "wrist"),
    "with depth and instances": tuple(
        camera + channel for camera in ("front", "wrist") for channel in ("", DEPTH, INSTANCES)
    ),
}


@dataclass(frozen=True, slots=True)
class CameraCost:
    """CPU time of one set of pictures at one size: medians over episodes."""

    pictures: str  # key of `CAMERA_SETS`
    width: int  # [px]
    height: int  # [px]
    frames_per_s: float  # of CPU time, after the first
    first_s: float  # CPU time of the first frame, with all that is prepared for the others [s]
    episodes: int


def bench_cameras(dataset: Dataset, sizes: Sequence[tuple[int, int]], episodes: int, frames: int) -> list[CameraCost]:
    """Measure every set of pictures at each size, width and height [px], in this process."""
    rows = sample_evenly(select_rows(dataset, failed=True), episodes)
    opened = [open_episode(dataset, row) for row in rows]
    costs = []
    for width, height in sizes:
        for name, pictures in CAMERA_SETS.items():
            firsts, rates = [], []
            for episode in opened:
                samples = np.linspace(0, len(episode.recording) - 1, frames + 1).astype(int).tolist()
                arm, started = load_recorded_arm(episode.recording), time.process_time()
                taken = iterate_recorded_pictures(pictures, episode, arm, (height, width), samples)
                next(taken)
                prepared = time.process_time()
                rates.append(sum(1 for _ in taken) / (time.process_time() - prepared))
                firsts.append(prepared - started)
            costs.append(CameraCost(name, width, height, median(rates), median(firsts), len(opened)))
    return costs
