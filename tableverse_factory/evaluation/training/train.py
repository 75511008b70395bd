"""Training of the segmentation network on views of synthetic scenes, with fixed seeds and checkpoints."""

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
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.training.differences import describe_settings
from tableverse_factory.evaluation.training.network import forward, list_layers, make_network
from tableverse_factory.evaluation.training.samples import make_batch
from tableverse_factory.evaluation.training.views import TrainingView
from tableverse_factory.models.local.device import Device, Tensor, import_torch
from tableverse_factory.stages.perceive.learned.features import OFFSET_UNIT_M

CHECKPOINT = "checkpoint.safetensors"
OFFSET_WEIGHT = 4.0
WEIGHT_DECAY = 1e-4
WARM_UP = 0.05
MAX_NORM = 1.0
AHEAD = 2  # batches that each process prepares ahead


@dataclass(frozen=True, slots=True)
class TrainSettings:
    """Settings that determine the weights, besides the device."""

    scenes: int
    steps: int  # each on `batch` random views
    seed: int = 0  # of scenes, first weights, order and augmentation
    batch: int = 16  # views per step
    rate: float = 3e-3  # peak learning rate


@dataclass(frozen=True, slots=True)
class TrainProgress:
    """Losses of one step."""

    step: int  # number of the step, from 1
    objects: float  # cross entropy of objectness
    offset_m: float  # mean error of the offsets, each object with the same weight [m]


def train_network(
    paths: Sequence[Path],
    folder: Path,
    settings: TrainSettings,
    device: Device,
    on_step: Callable[[TrainProgress], object] = lambda _: None,
    checkpoint_every: int = 100,
    jobs: int = 0,
) -> Any:
    """Train the network on views, from a checkpoint of the same settings if there is one; return it on the CPU.

    Weights differ in the last digits between a CPU and a GPU. A checkpoint is written into the folder after so many
    steps and after the last one. `jobs` processes augment views; with 0 this process does. A checkpoint of another
    training or network, a damaged view, and the death of a process are `InputError`s.
    """
    torch = import_torch()
    network = make_network(settings.seed).to(device.torch_device).train()
    optimizer = torch.optim.AdamW(network.parameters(), lr=settings.rate, weight_decay=WEIGHT_DECAY)
    done = _load_checkpoint(folder / CHECKPOINT, network, optimizer, settings)
    with _translate_worker_deaths():
        for step, batch in enumerate(_load_batches(paths, settings, done, jobs), done):
            for group in optimizer.param_groups:
                group["lr"] = compute_rate(step, settings)
            optimizer.zero_grad()
            objects, offset = compute_losses(network, *(part.to(device.torch_device) for part in batch))
            (objects + OFFSET_WEIGHT * offset).backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_NORM)
            optimizer.step()
            if (step + 1) % checkpoint_every == 0 or step + 1 == settings.steps:
                _save_checkpoint(folder / CHECKPOINT, network, optimizer, settings, step + 1)
            on_step(TrainProgress(step + 1, float(objects.detach()), float(offset.detach()) * OFFSET_UNIT_M))
    return network.cpu().eval()


def compute_losses(
    network: Any, inputs: Tensor, is_object: Tensor, offsets: Tensor, counted: Tensor, share: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute the cross entropy of objectness and the mean offset error in its unit for a batch."""
    torch = import_torch()
    outputs = forward(network, inputs)
    entropy = torch.nn.functional.binary_cross_entropy_with_logits(outputs[:, 0], is_object, reduction="none")
    error = ((outputs[:, 1:] - offsets) ** 2).sum(dim=1).add(1e-6).sqrt()
    return (entropy * counted).sum() / counted.sum().clamp(min=1.0), (error * share).sum() / share.sum().clamp(min=1e-6)


def compute_rate(step: int, settings: TrainSettings) -> float:
    """Compute the learning rate: linear warm-up, then cosine decay to a hundredth."""
    warm = max(1, round(WARM_UP * settings.steps))
    if step < warm:
        return settings.rate * (step + 1) / warm
    along = (step - warm) / max(1, settings.steps - warm)
    return settings.rate * (0.01 + 0.99 * 0.5 * (1.0 + float(np.cos(np.pi * along))))


@dataclass(frozen=True, slots=True)
class _StepDataset:
    """The batches by step for torch's loader, determined by seed and step.

    Errors of views are returned, not raised: torch would wrap them in a long traceback.
    """

    paths: Sequence[Path]
    settings: TrainSettings

    def __len__(self) -> int:
        return self.settings.steps

    def __getitem__(self, step: int) -> tuple[Tensor, ...] | InputError:
        rng = make_rng(self.settings.seed, f"step_{step}", "train")
        chosen = rng.integers(len(self.paths), size=self.settings.batch)
        try:
            with threadpool_limits(1):
                batch = make_batch([TrainingView.read(self.paths[int(k)]) for k in chosen], rng)
        except InputError as error:
            return error
        return tuple(import_torch().tensor(getattr(batch, field.name)) for field in fields(batch))


@contextmanager
def _translate_worker_deaths() -> Iterator[None]:
    """Translate the death of a loader process, which torch's signal handler raises anywhere in a step."""
    try:
        yield
    except RuntimeError as error:
        if not str(error).startswith("DataLoader worker (pid"):
            raise
        raise InputError(
            "a process that augments views died: out of memory, or a view crashed it; the same command continues from "
            "the checkpoint, and fewer --jobs need less memory"
        ) from error


def _load_batches(paths: Sequence[Path], settings: TrainSettings, done: int, jobs: int) -> Iterator[tuple[Tensor, ...]]:
    """Load the arrays of the remaining batches in order."""
    loader: Iterable[tuple[Tensor, ...] | InputError] = import_torch().utils.data.DataLoader(
        _StepDataset(paths, settings),
        batch_size=None,
        sampler=range(done, settings.steps),
        num_workers=jobs,
        prefetch_factor=AHEAD if jobs else None,
        multiprocessing_context="spawn" if jobs else None,  # forked children would inherit held locks
    )
    for batch in loader:
        if isinstance(batch, InputError):
            raise batch
        yield batch


def _fingerprint_network() -> str:
    return content_hash(repr(list_layers()).encode())


def _save_checkpoint(path: Path, network: Any, optimizer: Any, settings: TrainSettings, step: int) -> None:
    safetensors = import_extra("safetensors.torch", "training", "models")
    tensors = {f"net.{name}": tensor.contiguous() for name, tensor in network.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": tensor.contiguous() for name, tensor in state.items()}
    partial = path.with_suffix(".partial")
    metadata = {"settings": json.dumps(asdict(settings)), "net": _fingerprint_network(), "step": str(step)}
    safetensors.save_file(tensors, partial, metadata)
    partial.rename(path)


def _load_checkpoint(path: Path, network: Any, optimizer: Any, settings: TrainSettings) -> int:
    """Restore weights and optimizer from a checkpoint; return the number of finished steps."""
    if not path.is_file():
        return 0
    safetensors = import_extra("safetensors", "training", "models")
    try:
        with safetensors.safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 it is no mapping
        theirs = {**json.loads(metadata["settings"])}
    except (OSError, safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is not a checkpoint ({error}): remove it, or give another folder") from error
    if changes := describe_settings(theirs, asdict(settings)):
        raise InputError(f"{path} is of another training: {'; '.join(changes)}. Give the same, or another folder")
    if metadata.get("net") != _fingerprint_network():
        raise InputError(f"{path} is of another network than this version trains: remove it, or give another folder")
    network.load_state_dict({k.removeprefix("net."): v for k, v in tensors.items() if k.startswith("net.")})
    state: dict[int, dict[str, Any]] = {}
    for name, tensor in tensors.items():
        if name.startswith("adam."):
            _, index, part = name.split(".")
            state.setdefault(int(index), {})[part] = tensor
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
    return int(metadata["step"])
