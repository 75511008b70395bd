"""Packing of the first pictures of a dataset's successful motions, in the order of their demonstrations."""

import io
from collections.abc import Callable, Sequence

import numpy as np
from PIL import Image

from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.delivery.episodes.instructions import paraphrase_instruction, read_instruction
from tableverse_factory.delivery.episodes.pictures import take_recorded_pictures
from tableverse_factory.delivery.episodes.selection import Episode, load_recording
from tableverse_factory.evaluation.training.policy.first_pictures import (
    CAMERAS,
    QUALITY,
    SIZE,
    WORDINGS,
    FirstPictures,
    number_words,
)
from tableverse_factory.evaluation.training.policy.pack import Row, list_motions
from tableverse_factory.robotics.robots.registry import load_arm


def pack_pictures(
    datasets: Sequence[Dataset],
    splits: Sequence[str] = ("train", "validation"),
    robot: str = "panda",
    on_scene: Callable[[int, int], object] = lambda _done, _total: None,
    jobs: int = 1,
) -> FirstPictures:
    """Take and pack the pictures that `pack_demonstrations` with the same arguments has the motions of."""
    motions = list_motions(datasets, splits, robot)
    scenes = [(str(own.dataset.path), robot, own.scene_id, own.rows) for own in motions]
    files: list[bytes] = []
    words: list[np.ndarray] = []
    for done, own in enumerate(parallel_map(_take_pictures, scenes, jobs, "takes pictures"), 1):
        files += [file for pictures, _ in own for file in pictures]
        words += [numbers for _, numbers in own]
        on_scene(done, len(scenes))
    ends = np.cumsum([len(file) for file in files], dtype=np.int64).reshape(-1, len(CAMERAS))
    return FirstPictures(np.frombuffer(b"".join(files), np.uint8), ends, np.array(words, dtype=np.int16))


def _take_pictures(scene: tuple[str, str, str, tuple[Row, ...]]) -> list[tuple[list[bytes], np.ndarray]]:
    """Take the pictures of a scene's motions, and number the words of their instructions."""
    path, robot, scene_id, rows = scene
    opened, arm, found = open_dataset(path).scene(scene_id), load_arm(robot), []
    for row in rows:
        episode = Episode(row, opened, load_recording(opened, row))
        taken = take_recorded_pictures(CAMERAS, episode, arm, SIZE, [0])
        instruction = read_instruction(row)
        wordings = [instruction, *paraphrase_instruction(instruction)]
        numbers = [number_words(wordings[k % len(wordings)]) for k in range(WORDINGS)]
        found.append(([_encode(taken[camera][0]) for camera in CAMERAS], np.array(numbers)))
    return found


def _encode(picture: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=QUALITY)
    return file.getvalue()
