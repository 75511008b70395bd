"""Packing of the first pictures of a dataset's successful motions, in the order of their demonstrations."""

import io
from collections.abc import Callable, Sequence

import numpy as np
from PIL import Image

from tableverse_factory.dataset.dataset import Dataset
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
from tableverse_factory.evaluation.training.policy.pack import list_motions
from tableverse_factory.robotics.robots.registry import load_arm


def pack_pictures(
    dataset: Dataset,
    splits: Sequence[str] = ("train", "validation"),
    robot: str = "panda",
    on_scene: Callable[[int, int], object] = lambda _done, _total: None,
) -> FirstPictures:
    """Take and pack the pictures that `pack_demonstrations` with the same arguments has the motions of."""
    files, words, arm = [], [], load_arm(robot)
    motions = list_motions(dataset, splits, robot)
    for done, (scene_id, (rows, _)) in enumerate(motions.items(), 1):
        scene = dataset.scene(scene_id)
        for row in rows:
            episode = Episode(row, scene, load_recording(scene, row))
            taken = take_recorded_pictures(CAMERAS, episode, arm, SIZE, [0])
            files += [_encode(taken[camera][0]) for camera in CAMERAS]
            instruction = read_instruction(row)
            wordings = [instruction, *paraphrase_instruction(instruction)]
            words.append([number_words(wordings[k % len(wordings)]) for k in range(WORDINGS)])
        on_scene(done, len(motions))
    ends = np.cumsum([len(file) for file in files], dtype=np.int64).reshape(-1, len(CAMERAS))
    return FirstPictures(np.frombuffer(b"".join(files), np.uint8), ends, np.array(words, dtype=np.int16))


def _encode(picture: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "JPEG", quality=QUALITY)
    return file.getvalue()
