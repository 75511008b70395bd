"""Trains the segmenter on views of synthetic scenes: fixed seeds, checkpoints that it goes on from, an ONNX file."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from schemas.identity import content_hash
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.optional_imports import require_extra
from tableverse_factory.core.seeding import rng_for
from tableverse_factory.evaluation.training.network import forward, layers, new_network
from tableverse_factory.evaluation.training.samples import batch_of
from tableverse_factory.evaluation.training.views import TrainingView
from tableverse_factory.models.local.device import Device, Tensor, torch_here
from tableverse_factory.stages.perceive.learned.features import OFFSET_UNIT_M

CHECKPOINT = "checkpoint.safetensors"
OFFSET_WEIGHT = 4.0
WEIGHT_DECAY = 1e-4
WARM_UP = 0.05
MAX_NORM = 1.0
AHEAD = 2
"""Batches that each process has ready while another is learnt from."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What decides the weights, besides the device.

    Attributes:
        scenes: Synthetic scenes to learn from.
        steps: Batches, each of `batch` views drawn at random.
        seed: Of scenes, first weights, order and variation.
        batch: Views per step.
        rate: Highest learning rate.
    """

    scenes: int
    steps: int
    seed: int = 0
    batch: int = 16
    rate: float = 3e-3


@dataclass(frozen=True, slots=True)
class TrainProgress:
    """One step's losses.

    Attributes:
        step: Counted from 1.
        objects: Cross entropy of being an object.
        offset_m: Mean distance between the offsets said and true, each object counting the same [m].
    """

    step: int
    objects: float
    offset_m: float


def train(
    paths: Sequence[Path],
    folder: Path,
    settings: Settings,
    device: Device,
    on_step: Callable[[TrainProgress], object] = lambda _: None,
    checkpoint_every: int = 100,
    jobs: int = 0,
) -> Any:
    """The trained net, on the CPU. Where the folder holds a checkpoint of the same settings it goes on from there.

    Args:
        paths: Views, see `make_views`.
        folder: For the checkpoint.
        settings: What decides the weights.
        device: Where it is trained; weights differ in the last digits between a CPU and a GPU.
        on_step: Called after each step.
        checkpoint_every: Steps between two checkpoints; one is also written in the end.
        jobs: Processes that vary views meanwhile; with 0 that is done in turn with the learning.

    Raises:
        InputError: if the folder holds the checkpoint of another training or net, a view is none, or a process died.
    """
    torch = torch_here()
    network = new_network(settings.seed).to(device.where).train()
    optimizer = torch.optim.AdamW(network.parameters(), lr=settings.rate, weight_decay=WEIGHT_DECAY)
    done = _resume(folder / CHECKPOINT, network, optimizer, settings)
    with _deaths_told():
        for step, batch in enumerate(_batches(paths, settings, done, jobs), done):
            for group in optimizer.param_groups:
                group["lr"] = rate_at(step, settings)
            optimizer.zero_grad()
            objects, offset = losses(network, *(part.to(device.where) for part in batch))
            (objects + OFFSET_WEIGHT * offset).backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_NORM)
            optimizer.step()
            if (step + 1) % checkpoint_every == 0 or step + 1 == settings.steps:
                _save(folder / CHECKPOINT, network, optimizer, settings, step + 1)
            on_step(TrainProgress(step + 1, float(objects.detach()), float(offset.detach()) * OFFSET_UNIT_M))
    return network.cpu().eval()


def losses(
    network: Any, inputs: Tensor, is_object: Tensor, offsets: Tensor, counted: Tensor, share: Tensor
) -> tuple[Tensor, Tensor]:
    """Cross entropy of being an object, and mean length of the offsets' error in their unit, of a `Batch`'s arrays."""
    torch = torch_here()
    said = forward(network, inputs)
    entropy = torch.nn.functional.binary_cross_entropy_with_logits(said[:, 0], is_object, reduction="none")
    error = ((said[:, 1:] - offsets) ** 2).sum(dim=1).add(1e-6).sqrt()
    return (entropy * counted).sum() / counted.sum().clamp(min=1.0), (error * share).sum() / share.sum().clamp(min=1e-6)


def rate_at(step: int, settings: Settings) -> float:
    """Learning rate: up in a straight line, then down along a cosine to a hundredth."""
    warm = max(1, round(WARM_UP * settings.steps))
    if step < warm:
        return settings.rate * (step + 1) / warm
    along = (step - warm) / max(1, settings.steps - warm)
    return settings.rate * (0.01 + 0.99 * 0.5 * (1.0 + float(np.cos(np.pi * along))))


@dataclass(frozen=True, slots=True)
class _Steps:
    """The batch of each step, as torch's loader asks for it; it depends on seed and step alone.

    What is wrong with a view is given, not raised: torch would make a page of it.
    """

    paths: Sequence[Path]
    settings: Settings

    def __len__(self) -> int:
        return self.settings.steps

    def __getitem__(self, step: int) -> tuple[Tensor, ...] | InputError:
        rng = rng_for(self.settings.seed, f"step_{step}", "train")
        chosen = rng.integers(len(self.paths), size=self.settings.batch)
        try:
            with threadpool_limits(1):
                batch = batch_of([TrainingView.read(self.paths[int(k)]) for k in chosen], rng)
        except InputError as error:
            return error
        return tuple(torch_here().tensor(getattr(batch, field.name)) for field in fields(batch))


@contextmanager
def _deaths_told() -> Iterator[None]:
    """A process of the loader that died is an `InputError`: torch's handler of the signal raises anywhere in a step."""
    try:
        yield
    except RuntimeError as error:
        if not str(error).startswith("DataLoader worker (pid"):
            raise
        raise InputError(
            "a process that varies views died: its memory ran out, or a view crashed it; the same command goes on from "
            "the checkpoint, with fewer --jobs it needs less"
        ) from error


def _batches(paths: Sequence[Path], settings: Settings, done: int, jobs: int) -> Iterator[tuple[Tensor, ...]]:
    """The arrays of the batches that are left, in order, whoever makes them."""
    loader: Iterable[tuple[Tensor, ...] | InputError] = torch_here().utils.data.DataLoader(
        _Steps(paths, settings),
        batch_size=None,
        sampler=range(done, settings.steps),
        num_workers=jobs,
        prefetch_factor=AHEAD if jobs else None,
        multiprocessing_context="spawn" if jobs else None,  # forked children would share locks of libraries at work
    )
    for batch in loader:
        if isinstance(batch, InputError):
            raise batch
        yield batch


def _net() -> str:
    """Changes with every layer of the net."""
    return content_hash(repr(layers()).encode())


def _save(path: Path, network: Any, optimizer: Any, settings: Settings, step: int) -> None:
    safetensors = require_extra("safetensors.torch", "training", "models")
    tensors = {f"net.{name}": tensor.contiguous() for name, tensor in network.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": tensor.contiguous() for name, tensor in state.items()}
    partial = path.with_suffix(".partial")
    told = {"settings": json.dumps(asdict(settings)), "net": _net(), "step": str(step)}
    safetensors.save_file(tensors, partial, told)
    partial.rename(path)


def _resume(path: Path, network: Any, optimizer: Any, settings: Settings) -> int:
    """Steps that are done already; weights and the optimizer's state as they were after them."""
    if not path.is_file():
        return 0
    safetensors = require_extra("safetensors", "training", "models")
    try:
        with safetensors.safe_open(path, "pt") as file:
            told = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 it is no mapping
    except (OSError, safetensors.SafetensorError) as error:
        raise InputError(f"{path} is no checkpoint ({error}): remove it, or give another folder") from error
    if told.get("settings") != json.dumps(asdict(settings)):
        raise InputError(f"{path} is of another training, {told.get('settings')}: give the same, or another folder")
    if told.get("net") != _net():
        raise InputError(f"{path} is of another net than this version trains: remove it, or give another folder")
    network.load_state_dict({k.removeprefix("net."): v for k, v in tensors.items() if k.startswith("net.")})
    state: dict[int, dict[str, Any]] = {}
    for name, tensor in tensors.items():
        if name.startswith("adam."):
            _, index, part = name.split(".")
            state.setdefault(int(index), {})[part] = tensor
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
    return int(told["step"])
