"""Checkpoints of a training that continues in parts, and its averaged weights in half precision."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.file_hash import hash_file
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.evaluation.training.differences import (
    Inputs,
    describe_inputs,
    describe_settings,
)
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

CHECKPOINT = "checkpoint.safetensors"
WEIGHTS = "weights.safetensors"
Position = TypeVar("Position")


@dataclass(frozen=True, slots=True)
class Trained:
    """What a training changes: the network, its averaged weights, and the optimizer."""

    network: Any
    average: Any
    optimizer: Any


def save_checkpoint(folder: Path, trained: Trained, settings: Any, inputs: Inputs, positions: Sequence[Any]) -> None:
    """Write everything that the training needs to go on.

    Settings and positions, of which each of its processes has one, are dataclasses of plain values.
    """
    safetensors = import_extra("safetensors.torch", "training", "models")
    tensors = {f"net.{name}": tensor.contiguous().clone() for name, tensor in trained.network.state_dict().items()}
    tensors |= {f"mean.{name}": tensor.contiguous().clone() for name, tensor in trained.average.state_dict().items()}
    for index, state in trained.optimizer.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": tensor.contiguous() for name, tensor in state.items()}
    metadata = {
        "settings": json.dumps(asdict(settings)),
        "inputs": json.dumps(inputs),
        "positions": json.dumps([asdict(each) for each in positions]),
    }
    partial = folder / f"{CHECKPOINT}.partial"
    safetensors.save_file(tensors, partial, metadata)
    partial.rename(folder / CHECKPOINT)


def load_checkpoint(
    folder: Path,
    trained: Trained,
    settings: Any,
    inputs: Inputs,
    start: Position,
    device: str,
    rank: int = 0,
    ranks: int = 1,
) -> Position:
    """Restore a training of the same settings, but for `steps`, and inputs; `start` if there is no checkpoint.

    Returns the position of the process `rank` of `ranks`.
    """
    path = folder / CHECKPOINT
    if not path.is_file():
        return start
    safetensors = import_extra("safetensors", "training", "models")
    try:
        with safetensors.safe_open(path, "pt", device=device) as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 it is no mapping
        theirs = type(settings)(**json.loads(metadata["settings"]))
        read = {name: (str(path), str(digest)) for name, (path, digest) in json.loads(metadata["inputs"]).items()}
        positions = [type(start)(**each) for each in json.loads(metadata["positions"])]
    except (OSError, safetensors.SafetensorError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is not a checkpoint of this version ({error}): remove it, or give another folder"
        ) from error
    changes = describe_settings(asdict(replace(theirs, steps=settings.steps)), asdict(settings))
    if changes := changes + describe_inputs(read, inputs):
        raise InputError(f"{path} is of another training: {'; '.join(changes)}. Give the same, or another folder")
    if len(positions) != ranks:
        raise InputError(f"{path} lacks the positions of {ranks} processes: remove it")
    try:
        trained.network.load_state_dict(_pick(tensors, "net."))
        trained.average.load_state_dict(_pick(tensors, "mean."))
    except RuntimeError as error:
        raise InputError(f"{path} is of another network than this version trains: remove it") from error
    parameters = [each for group in trained.optimizer.param_groups for each in group["params"]]
    state: dict[int, dict[str, Any]] = {}
    for name, tensor in _pick(tensors, "adam.").items():
        index, _, part = name.partition(".")
        like = parameters[int(index)]
        if tensor.shape == like.shape:  # the fused optimizer wants the weights' order in memory
            tensor = torch.empty_like(like).copy_(tensor)
        state.setdefault(int(index), {})[part] = tensor
    trained.optimizer.load_state_dict({**trained.optimizer.state_dict(), "state": state})
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
    partial.write_bytes(safetensors.save(weights))  # `save_file` would let nobody else read it
    partial.rename(folder / WEIGHTS)


def read_weights(path: Path, network: Any) -> None:
    """Load the weights that `write_weights` wrote."""
    safetensors = import_extra("safetensors", "training", "models")
    if not path.is_file():
        raise InputError(f"{path}: there is no such file: give the weights that a training wrote")
    digest = "unreadable"
    try:
        digest = hash_file(path)[:12]
        with safetensors.safe_open(path, "pt") as file:
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 it is no mapping
        network.load_state_dict({k: each.float() if each.is_floating_point() else each for k, each in weights.items()})
        if not all(each.isfinite().all() for each in network.parameters()):
            raise ValueError("numbers that are not finite")
    except (OSError, safetensors.SafetensorError, RuntimeError, ValueError) as error:
        why = sanitize_line(" ".join(str(error).split()), 200)
        raise InputError(
            f"{path} (sha256 {digest}) holds no weights of this network ({why}): give those that a training of it wrote"
        ) from error
