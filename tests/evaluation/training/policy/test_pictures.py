"""First pictures: what is packed, what is refused, and a policy that is trained on them and plays."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from tableverse_factory import TableEnv
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.dataset.splits import SPLITS
from tableverse_factory.delivery.episodes.pictures import take_recorded_pictures
from tableverse_factory.delivery.episodes.selection import Episode
from tableverse_factory.evaluation.training.policy.first_pictures import (
    CAMERAS,
    SIZE,
    WORDS,
    FirstPictures,
    number_words,
)
from tableverse_factory.evaluation.training.policy.pack_pictures import pack_pictures
from tableverse_factory.robotics.robots.registry import load_arm

torch = pytest.importorskip("torch", reason="the extra `models` is not installed")
from safetensors.torch import load_file  # noqa: E402

from tableverse_factory.evaluation.training.checkpoint import WEIGHTS  # noqa: E402
from tableverse_factory.evaluation.training.policy import validate  # noqa: E402
from tableverse_factory.evaluation.training.policy.settings import PolicySettings  # noqa: E402
from tableverse_factory.evaluation.training.policy.train import (  # noqa: E402
    TrainRun,
    train_picture_policy,
    train_state_policy,
)

pytestmark = [pytest.mark.heavy, pytest.mark.usefixtures("thin")]


@pytest.fixture(scope="module")
def pictures(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pictures") / "pictures.npz"
    pack_pictures([dataset], tuple(SPLITS)).write(path)
    return path


def test_they_are_those_of_the_first_sample_and_the_environments_words(dataset: Dataset, pictures: Path) -> None:
    packed, scene = FirstPictures.read(pictures), dataset.scene("s-0")
    done = next(iter(scene.trajectories()))
    episode = Episode(done.row, scene, done.recording())
    taken = take_recorded_pictures(CAMERAS, episode, load_arm("panda"), SIZE, [0])
    decoded = packed.decode()
    assert decoded.shape == (1, len(CAMERAS), *SIZE, 3)
    for shown, camera in zip(decoded[0], CAMERAS, strict=True):
        assert np.abs(shown.astype(int) - taken[camera][0].astype(int)).mean() < 3.0
    _, info = TableEnv(scene, "task_000").reset(seed=0)
    assert np.array_equal(packed.words[0, 0], number_words(info["instruction"]))
    assert np.array_equal(packed.words[0, 1], number_words(info["paraphrases"][0]))
    assert number_words("Pick up the mug!").tolist() == number_words("pick up THE mug").tolist()
    assert len(number_words("a " * 100)) == WORDS


def test_files_of_other_content_are_refused(pictures: Path, tmp_path: Path) -> None:
    packed, path, data = FirstPictures.read(pictures), tmp_path / "bad.npz", pictures.read_bytes()
    for damaged in (b"", data[: len(data) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="no packed pictures"):
            FirstPictures.read(path)
    arrays = {field.name: getattr(packed, field.name) for field in fields(packed)}
    for change in ({"ends": packed.ends + 1}, {"words": packed.words - 1}, {"files": packed.files[:-1]}):
        np.savez_compressed(path, **{**arrays, **change})
        with pytest.raises(InputError, match="no packed pictures"):
            FirstPictures.read(path)


def test_goals_are_learnt_from_pictures_and_motions_stay(
    packed: Path, pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(validate, "GOALS", 4)
    monkeypatch.setattr(validate, "CHUNKS", 8)
    settings = PolicySettings(2, goals=2, flows=2, chunks=4)
    train_state_policy(settings, TrainRun(tmp_path / "state", packed, "cpu"), lambda _: None)
    state = tmp_path / "state" / WEIGHTS
    for minutes, folder in ((9.0, "whole"), (0.0, "parts"), (0.0, "parts")):
        run = TrainRun(tmp_path / folder, packed, "cpu", minutes)
        train_picture_policy(settings, run, pictures, state, lambda _: None)
    whole, parts, teacher = (load_file(tmp_path / name / WEIGHTS) for name in ("whole", "parts", "state"))
    for name, tensor in whole.items():
        assert torch.equal(tensor, parts[name]), name
        assert not name.startswith("motion.") or torch.equal(tensor, teacher[name]), name
    many = tmp_path / "many.npz"
    own = FirstPictures.read(pictures)
    replace(own, ends=own.ends[:0], words=own.words[:0], files=own.files[:0]).write(many)
    with pytest.raises(InputError, match="has pictures of 0 demonstrations, not of 1"):
        train_picture_policy(settings, run, many, state, lambda _: None)
