"""Where models with weights run, and in which precision; torch is imported here and nowhere earlier."""

import os
from dataclasses import dataclass
from typing import Any, Literal

from schemas.config import ModelsConfig
from tableverse_factory.core.errors import InputError, ModelAccessError
from tableverse_factory.core.optional_imports import require_extra

Tensor = Any
"""A `torch.Tensor`; torch is an extra, and not there for whoever checks types without it."""


@dataclass(frozen=True, slots=True)
class Device:
    """A processor and a precision.

    Attributes:
        kind: Which processor.
        precision: Of weights and activations.
    """

    kind: Literal["cpu", "cuda"]
    precision: Literal["float32", "bfloat16"]

    @property
    def where(self) -> Any:
        """As torch calls it."""
        return torch_here().device(self.kind)

    @property
    def dtype(self) -> Any:
        """As torch calls it."""
        return getattr(torch_here(), self.precision)


def device_of(config: ModelsConfig, said: str = "models.device") -> Device:
    """What `models.device` and `models.precision` mean on this machine.

    Args:
        config: What is asked for.
        said: Where the user said so, for the error.

    Raises:
        ModelAccessError: without torch, or where a GPU is asked for and torch sees none.
    """
    sees_gpu = torch_here().cuda.is_available() if config.device != "cpu" else False
    if config.device == "cuda" and not sees_gpu:
        raise ModelAccessError(
            f"{said} is 'cuda', but torch sees no GPU here: install a CUDA build of torch and a driver, on a "
            "cluster give the pool a GPU (docs/cluster.md), or say 'auto' or 'cpu'"
        )
    kind: Literal["cpu", "cuda"] = "cuda" if sees_gpu else "cpu"
    if config.precision != "auto":
        return Device(kind, config.precision)
    return Device(kind, "bfloat16" if kind == "cuda" else "float32")


def torch_here() -> Any:
    """The module torch, set up for the same bytes every time.

    One thread on a CPU; on a GPU cuDNN's deterministic kernels, none chosen by a race, and float32 that is no TF32.

    Raises:
        ModelAccessError: where it is not installed.
    """
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # before the first CUDA call, or it is not heard
    try:
        torch: Any = require_extra("torch", "a model with weights", "models")
    except InputError as error:
        raise ModelAccessError(str(error)) from None
    if torch.get_num_threads() != 1:
        torch.set_num_threads(1)
    torch.backends.cudnn.benchmark = False
    torch.backends.cudnn.deterministic = True
    torch.backends.cudnn.allow_tf32 = False
    return torch
