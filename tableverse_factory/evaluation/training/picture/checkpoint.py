"""Settings and checkpoints of a training of pictures, and its averaged weights in half precision."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

CHECKPOINT = "checkpoint.safetensors"
WEIGHTS = "weights.safetensors"


@dataclass(frozen=True, slots=True)
class PictureSettings:
    """Settings that determine the weights, with the meshes of the pool and the device.

    Attributes:
        steps: Of `batch` views per process; a continued training may change them, and with them its schedule.
        scenes: Arrangements in the pool of meshes.
        capacity: Views that are kept to draw from.
        first: Views that are rendered before the first step.
        fresh: New views that are rendered per step, by all processes together.
        small: Share of the steps, the first ones, whose samples have five sixths of the views' width and height.
        samples: Rays per pixel.
        packages, patterns: Textures, of which a package has three.
        flat: Flat pictures that show no table.
        rate: Peak of the learning rate.
        gpus: Processes, a GPU each, that average their gradients.
        start: SHA-256 of the weights that the training starts from; empty if it starts from random ones.
    """

    steps: int
    scenes: int = 1200
    seed: int = 0
    batch: int = 64
    width: int = 384
    height: int = 288
    capacity: int = 24_000
    first: int = 2_000
    fresh: float = 12.0
    small: float = 0.6
    samples: int = 12
    packages: int = 320
    patterns: int = 900
    flat: int = 1_200
    rate: float = 1.2e-3
    gpus: int = 1
    start: str = ""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a view [px]."""
        return self.width, self.height

    def sample_size(self, step: int) -> tuple[int, int]:
        """Width and height of the samples of a step [px], multiples of the network's 16."""
        if step > self.small * self.steps:
            return self.size
        return max(16, self.width * 5 // 96 * 16), max(16, self.height * 5 // 96 * 16)


@dataclass(frozen=True, slots=True)
class TrainPosition:
    """How far a process has come: steps, packs, views, and the numbers of views of the packs in its ring.

    `pool` is the sha256 of the file of meshes.
    """

    step: int = 0
    packs: int = 0
    made: int = 0
    past: tuple[int, ...] = ()
    pool: str = ""


def save_checkpoint(
    folder: Path,
    network: Any,
    average: Any,
    optimizer: Any,
    settings: PictureSettings,
    positions: Sequence[TrainPosition],
) -> None:
    """Write everything that the training needs to go on; `positions` are those of its processes."""
    safetensors = import_extra("safetensors.torch", "training", "models")
    tensors = {f"net.{name}": tensor.contiguous().clone() for name, tensor in network.state_dict().items()}
    tensors |= {f"mean.{name}": tensor.contiguous().clone() for name, tensor in average.state_dict().items()}
    for index, state in optimizer.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": tensor.contiguous() for name, tensor in state.items()}
    metadata = {"settings": json.dumps(asdict(settings)), "positions": json.dumps([asdict(p) for p in positions])}
    partial = folder / f"{CHECKPOINT}.partial"
    safetensors.save_file(tensors, partial, metadata)
    partial.rename(folder / CHECKPOINT)


def load_checkpoint(
    folder: Path, network: Any, average: Any, optimizer: Any, settings: PictureSettings, device: str, rank: int = 0
) -> TrainPosition:
    """Restore a training of the same settings, but for `steps`; the start if there is no checkpoint.

    Returns the position of the process `rank`.
    """
    path = folder / CHECKPOINT
    if not path.is_file():
        return TrainPosition()
    safetensors = import_extra("safetensors", "training", "models")
    try:
        with safetensors.safe_open(path, "pt", device=device) as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 it is no mapping
        theirs = PictureSettings(**json.loads(metadata["settings"]))
        positions = [TrainPosition(**each) for each in json.loads(metadata["positions"])]
    except (OSError, safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is not a checkpoint ({error}): remove it, or give another folder") from error
    if replace(theirs, steps=settings.steps) != settings:
        raise InputError(f"{path} is of another training, {theirs}: give the same, or another folder")
    if len(positions) != settings.gpus:
        raise InputError(f"{path} lacks the positions of {settings.gpus} processes: remove it")
    try:
        network.load_state_dict(_pick(tensors, "net."))
        average.load_state_dict(_pick(tensors, "mean."))
    except RuntimeError as error:
        raise InputError(f"{path} is of another network than this version trains: remove it") from error
    parameters = [each for group in optimizer.param_groups for each in group["params"]]
    state: dict[int, dict[str, Any]] = {}
    for name, tensor in _pick(tensors, "adam.").items():
        index, _, part = name.partition(".")
        like = parameters[int(index)]
        if tensor.shape == like.shape:  # the fused optimizer wants the order in memory of the weights
            tensor = torch.empty_like(like).copy_(tensor)
        state.setdefault(int(index), {})[part] = tensor
    optimizer.load_state_dict({**optimizer.state_dict(), "state": state})
    return positions[rank]


def _pick(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): each for name, each in tensors.items() if name.startswith(prefix)}


def write_weights(average: Any, folder: Path) -> None:
    """Write the averaged weights in half precision."""
    safetensors = import_extra("safetensors.torch", "training", "models")
    weights = {
        name: (each.half() if each.is_floating_point() else each).contiguous().cpu()
        for name, each in average.state_dict().items()
    }
    partial = folder / f"{WEIGHTS}.partial"
    safetensors.save_file(weights, partial)
    partial.rename(folder / WEIGHTS)


def read_weights(path: Path, network: Any) -> None:
    """Load the weights that `write_weights` wrote."""
    safetensors = import_extra("safetensors", "training", "models")
    try:
        with safetensors.safe_open(path, "pt") as file:
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 it is no mapping
        network.load_state_dict({k: each.float() if each.is_floating_point() else each for k, each in weights.items()})
    except (OSError, safetensors.SafetensorError, RuntimeError) as error:
        raise InputError(f"{path} holds no weights of this network: train it first") from error
