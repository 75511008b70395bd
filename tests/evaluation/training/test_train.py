"""The segmenter's training: it learns, goes on where it stopped, and its ONNX file says what the net says."""

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from typer.testing import CliRunner

from schemas.config import Config
from schemas.observation import Observation
from schemas.outcome import Done
from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.training.network import forward, make_network
from tableverse_factory.evaluation.training.onnx_file import write_onnx
from tableverse_factory.evaluation.training.samples import make_batch
from tableverse_factory.evaluation.training.train import CHECKPOINT, TrainProgress, TrainSettings, train_network
from tableverse_factory.evaluation.training.views import VIEWS_PER_SCENE, TrainingView, make_views, render_scene_views
from tableverse_factory.models.local.device import Device
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.learned.onnx import SegmentationNet
from tableverse_factory.stages.perceive.perceive import perceive
from tests.helpers.processes import command_of, kill_if_alive

torch = pytest.importorskip("torch")
CPU = Device("cpu", "float32")
SHORT = TrainSettings(scenes=1, steps=4, batch=1)


@pytest.fixture(scope="module")
def scene() -> list[TrainingView]:
    """Every view of one scene."""
    return render_scene_views(0, "train_0_000000")


@pytest.fixture(scope="module")
def views(scene: list[TrainingView], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Files of the middle of each view, so that a step costs little."""
    folder, part = tmp_path_factory.mktemp("views"), np.s_[56:184, 80:240]
    paths = [folder / f"{k}.npz" for k in range(len(scene))]
    for path, view in zip(paths, scene, strict=True):
        focal = view.focal - [0.0, 0.0, 80.0, 56.0]
        replace(view, depth=view.depth[part], ids=view.ids[part], focal=focal).write(path)
    return paths


class StoppedError(Exception):
    """As a kill would."""


@pytest.mark.heavy
def test_the_same_scene_gives_the_same_views_and_every_view_shows_things(
    scene: list[TrainingView], tmp_path: Path
) -> None:
    paths = make_views(tmp_path, 1, 0)
    assert len(paths) == VIEWS_PER_SCENE
    for path, other in zip(paths, scene, strict=True):
        view = TrainingView.read(path)
        assert np.array_equal(view.depth, other.depth)
        assert np.array_equal(view.ids, other.ids)
        assert len(np.unique(view.ids)) > 3
    before = [path.stat().st_mtime_ns for path in paths]
    assert make_views(tmp_path, 1, 0) == paths
    assert [path.stat().st_mtime_ns for path in paths] == before


def test_offsets_lead_from_every_pixel_to_one_middle_of_its_thing(views: list[Path]) -> None:
    view = TrainingView.read(views[0])
    batch = make_batch([view], np.random.default_rng(0))
    assert batch.inputs[0, 6].mean() > 0.7
    assert np.isclose(batch.share.sum(), len(np.unique(view.ids[(view.depth > 0) & (view.ids > 0)])), atol=1.01)
    assert np.all(batch.offsets[0][:, batch.is_object[0] == 0] == 0)
    assert np.abs(np.einsum("cij,ij->c", batch.offsets[0], batch.share[0])).max() < 1e-4


@pytest.fixture(scope="module")
def learnt(views: list[Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[object, list[TrainProgress]]:
    """A net after a few seconds, and what it said of itself."""
    told: list[TrainProgress] = []
    settings = TrainSettings(scenes=1, steps=40, batch=1)
    return train_network(views, tmp_path_factory.mktemp("learnt"), settings, CPU, told.append), told


@pytest.mark.slow  # many steps; tests/evaluation/training/policy learns in the fast run
@pytest.mark.heavy
def test_it_learns(learnt: tuple[object, list[TrainProgress]]) -> None:
    first, last = learnt[1][:6], learnt[1][-6:]
    assert sum(p.objects for p in last) < 0.65 * sum(p.objects for p in first)
    assert sum(p.offset_m for p in last) < 0.85 * sum(p.offset_m for p in first)


@pytest.mark.slow  # a training
@pytest.mark.heavy
def test_what_seconds_of_training_find_are_things(
    learnt: tuple[object, list[TrainProgress]], scene: list[TrainingView], tmp_path: Path
) -> None:
    path = tmp_path / "net.onnx"
    write_onnx(learnt[0], path)
    view = scene[0]
    depth = (view.depth * view.depth_scale).astype(np.float32)
    seen = Observation("view", np.zeros((*depth.shape, 3), dtype=np.uint8), depth, view.camera)
    config = Config.model_validate({"perceive": {"detector": "learned", "detector_weights": str(path)}})
    outcomes = [perceive(seen, config, np.random.default_rng(0), Services(tmp_path)) for _ in range(2)]
    found, again = (outcome.value for outcome in outcomes if isinstance(outcome, Done))
    assert found.perception == "learned"
    assert np.array_equal(found.instance_ids, again.instance_ids)
    said, true = found.instance_ids > 0, (view.ids > 0) & (depth > 0)
    assert (said & true).sum() > 0.7 * said.sum()
    assert (said & true).sum() > 0.5 * true.sum()


@pytest.mark.heavy
def test_stopped_and_resumed_gives_the_weights_of_one_go(views: list[Path], tmp_path: Path) -> None:
    def stop(progress: TrainProgress) -> None:
        if progress.step == 3:
            raise StoppedError

    (tmp_path / "whole").mkdir()
    (tmp_path / "parts").mkdir()
    whole = train_network(views, tmp_path / "whole", SHORT, CPU, checkpoint_every=2)
    with pytest.raises(StoppedError):
        train_network(views, tmp_path / "parts", SHORT, CPU, stop, checkpoint_every=2)
    done: list[TrainProgress] = []
    parts = train_network(views, tmp_path / "parts", SHORT, CPU, done.append, checkpoint_every=2)
    assert [p.step for p in done] == [3, 4]
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, parts.state_dict()[name]), name


@pytest.mark.slow
def test_processes_beside_it_change_no_weight(views: list[Path], tmp_path: Path) -> None:
    weights = []
    for jobs in (0, 2):
        folder = tmp_path / str(jobs)
        folder.mkdir()
        weights.append(train_network(views, folder, SHORT, CPU, jobs=jobs).state_dict())
    assert all(torch.equal(tensor, weights[1][name]) for name, tensor in weights[0].items())


@pytest.mark.heavy
def test_a_checkpoint_of_another_training_or_net_or_of_nothing_is_refused(
    views: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train_network(views, tmp_path, replace(SHORT, steps=1), CPU)
    with pytest.raises(InputError, match="another training: seed was 0 and is now 1"):
        train_network(views, tmp_path, replace(SHORT, steps=1, seed=1), CPU)
    with monkeypatch.context() as older:
        older.setattr("tableverse_factory.evaluation.training.network.WIDTHS", (16, 32, 64, 128))
        with pytest.raises(InputError, match=rf"{CHECKPOINT} is of another network .* remove it, or give another"):
            train_network(views, tmp_path, replace(SHORT, steps=1), CPU)
    (tmp_path / CHECKPOINT).write_bytes(b"\x80\x04 no safetensors")
    with pytest.raises(InputError, match="not a checkpoint"):
        train_network(views, tmp_path, SHORT, CPU)


def test_a_view_that_is_none_or_half_of_one_is_named(views: list[Path], tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(b"no view")
    (tmp_path / "half.npz").write_bytes(views[0].read_bytes()[:1000])
    with pytest.raises(InputError, match=r"half\.npz"):
        TrainingView.read(tmp_path / "half.npz")
    with pytest.raises(InputError, match=r"a\.npz") as told:
        TrainingView.read(tmp_path / "a.npz")
    assert "pickle" not in str(told.value), "numpy advises to load it unsafely"
    with pytest.raises(InputError, match=r"a\.npz"):
        train_network([tmp_path / "a.npz"], tmp_path, SHORT, CPU)


@pytest.mark.slow
def test_a_view_that_is_none_is_named_in_one_line_by_a_process_too(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(b"no view")
    with pytest.raises(InputError, match=r"a\.npz is not a training view") as told:
        train_network([tmp_path / "a.npz"], tmp_path, SHORT, CPU, jobs=1)
    assert "\n" not in str(told.value)


def test_a_process_that_dies_beside_it_ends_in_one_line(views: list[Path], tmp_path: Path) -> None:
    def kill() -> None:
        until = time.monotonic() + 20
        while time.monotonic() < until:
            for child in psutil.Process().children():
                if "spawn_main" in command_of(child) and kill_if_alive(child):
                    return
            time.sleep(0.05)

    killer = threading.Thread(target=kill)
    killer.start()
    with pytest.raises(InputError, match="a process that augments views died") as told:
        train_network(views, tmp_path, SHORT, CPU, jobs=1)
    killer.join()
    assert "\n" not in str(told.value)


@pytest.mark.heavy
def test_the_onnx_file_says_what_the_net_says_at_any_size(tmp_path: Path) -> None:
    network = make_network(1)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():  # as after training: the normalisation does something
        for name, tensor in network.named_buffers():
            if name.endswith(("running_mean", "running_var")):
                tensor.copy_(torch.rand(tensor.shape, generator=generator) + 0.5)
    network.eval()
    path = tmp_path / "net.onnx"
    assert write_onnx(network, path) < 1e-4
    first = path.read_bytes()
    write_onnx(network, path)
    assert path.read_bytes() == first
    assert len(first) < 10_000_000
    net = SegmentationNet(path)
    for height, width in ((32, 48), (64, 16)):
        inputs = np.random.default_rng(0).standard_normal((7, height, width)).astype(np.float32)
        with torch.inference_mode():
            said = forward(network, torch.tensor(inputs[None]))[0].numpy()
        assert np.allclose(net(inputs), said, atol=1e-3 * np.abs(said).max())
    assert sum(p.numel() for p in network.parameters()) < 2_500_000


@pytest.mark.heavy
def test_the_command_trains_exports_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tableverse_factory.evaluation.training.views.VIEWS_PER_SCENE", 1)
    options = "--scenes 1 --steps 1 --batch 1 --jobs 0 --device cpu"
    answer = CliRunner().invoke(app, ["train", "segmenter", str(tmp_path / "net"), *options.split()])
    assert answer.exit_code == 0, answer.output
    assert "segmenter.onnx: 8.7 MB" in answer.output
    assert (tmp_path / "net" / "segmenter.onnx").is_file()
