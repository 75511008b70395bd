"""Processor and precision of models with weights; the only place that imports torch."""

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from tableverse_factory.core.errors import InputError, WeightsError
from tableverse_factory.core.optional_imports import import_extra

if TYPE_CHECKING:  # where networks are trained, numpy and torch suffice
    from schemas.config import ModelsConfig

Tensor = Any  # A `torch.Tensor`; torch is an extra, and type checks must pass without it


@dataclass(frozen=True, slots=True)
class Device:
    """Processor and precision of a model; `precision` is that of weights and activations."""

    kind: Literal["cpu", "cuda"]
    precision: Literal["float32", "bfloat16"]

    @property
    def torch_device(self) -> Any:
        """The `torch.device`."""
        return import_torch().device(self.kind)

    @property
    def dtype(self) -> Any:
        """The `torch.dtype`."""
        return getattr(import_torch(), self.precision)


def select_device(config: "ModelsConfig", key: str = "models.device") -> Device:
    """Resolve `models.device` and `models.precision` on this machine; `key` is what sets the device, for the error.

    Raises:
        WeightsError: without torch, or if a GPU is required and torch sees none.
    """
    sees_gpu = import_torch().cuda.is_available() if config.device != "cpu" else False
    if config.device == "cuda" and not sees_gpu:
        raise WeightsError(
            f"{key} is 'cuda', but torch sees no GPU here: install a CUDA build of torch and a driver, on a "
            "cluster give the pool a GPU (docs/cluster.md), or set 'auto' or 'cpu'"
        )
    kind: Literal["cpu", "cuda"] = "cuda" if sees_gpu else "cpu"
    if config.precision != "auto":
        return Device(kind, config.precision)
    return Device(kind, "bfloat16" if kind == "cuda" else "float32")


def import_torch() -> Any:
    """Import torch, set up for reproducible bytes; WeightsError without it.

    One thread on a CPU; on a GPU cuDNN's deterministic kernels, no kernel benchmarks, and no TF32.
    """
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # must be set before the first CUDA call
    try:
        torch: Any = import_extra("torch", "a model with weights", "models")
    except InputError as error:
        raise WeightsError(str(error)) from None
    if torch.get_num_threads() != 1:
        torch.set_num_threads(1)
    torch.backends.cudnn.benchmark = False
    torch.backends.cudnn.deterministic = True
    torch.backends.cudnn.allow_tf32 = False
    return torch
