"""Inference in batches of one shape, with smaller batches where memory is short."""

import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

from tableverse_factory.core.errors import ModelError

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
# Messages of torch's allocators, the driver and CUDA's libraries when memory is short.
_NO_MEMORY = (
    *("DefaultCPUAllocator", "can't allocate memory", "CUDA out of memory", "CUDA error: out of memory"),
    *("CUBLAS_STATUS_ALLOC_FAILED", "CUDNN_STATUS_ALLOC_FAILED"),
)


def run_in_batches(
    run: Callable[[Sequence[_Item], int], Sequence[_Result]], items: Sequence[_Item], size: int
) -> tuple[list[_Result], int]:
    """Run a model on items; return the results in order, and the batch size that fitted.

    `run` computes one result for each item of a batch, and pads its tensors to the size that it is given: kernels are
    chosen by the shape, so a result does not depend on the number of other items. Where memory is short, the size is
    halved for the remaining items, and only then may the last digits differ; ModelError if not even one item fits.
    """
    results: list[_Result] = []
    while len(results) < len(items):
        part = list(items[len(results) : len(results) + size])
        try:
            answers = run(part, size)
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            if size == 1:
                raise ModelError(f"one item is too much for the memory of the model: {get_first_line(error)}") from None
            answers = None
        if answers is None:  # outside of `except`, where the error would keep the failed forward's tensors alive
            size = max(1, size // 2)
            empty_cache()
            continue
        if len(answers) != len(part):
            raise ModelError(f"a model gave {len(answers)} answers to {len(part)} items")
        results += answers
    return results, size


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that memory is short, on a GPU or on the CPU."""
    torch = sys.modules.get("torch")
    if isinstance(error, MemoryError) or (torch is not None and isinstance(error, torch.OutOfMemoryError)):
        return True
    return any(words in str(error) for words in _NO_MEMORY)


def is_cuda_failure(error: BaseException) -> bool:
    """Whether CUDA itself failed, so that every further call of this process fails too."""
    return "CUDA error" in str(error) and not is_out_of_memory(error)


def empty_cache() -> None:
    """Return the GPU memory that torch caches."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available():
        torch.cuda.empty_cache()


def get_first_line(error: BaseException) -> str:
    """Return the first line of an error's message, at most 200 characters."""
    return str(error).strip().partition("\n")[0][:200]
