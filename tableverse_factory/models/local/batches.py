"""Items through a model in batches of one shape, smaller ones where the memory does not do."""

import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

from tableverse_factory.core.errors import ModelError

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_NO_MEMORY = (
    "DefaultCPUAllocator",
    "can't allocate memory",
    "CUDA out of memory",
    "CUDA error: out of memory",
    "CUBLAS_STATUS_ALLOC_FAILED",
    "CUDNN_STATUS_ALLOC_FAILED",
)
"""How torch says so, besides by the class of its error: allocators of its own, the driver, and CUDA's libraries."""


def in_batches(
    run: Callable[[Sequence[_Item], int], Sequence[_Result]], items: Sequence[_Item], size: int
) -> tuple[list[_Result], int]:
    """What a model says of each item, in their order, and the size of batch that fitted.

    Every forward is to have the same shape: kernels are chosen by it, so a result does not depend on how many others
    were there. Where the memory is not enough, the size is halved for what is left; only then may the last digits
    differ.

    Args:
        run: Answers a batch, one result for each item; its tensors are to be filled up to the size, which is given.
        items: Any number of them.
        size: Items in a batch, at least 1.

    Raises:
        ModelError: if not even one item fits.
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
                raise ModelError(f"one item is too much for the memory of the model: {first_line(error)}") from None
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
    """Whether torch found no memory, on a GPU or on the CPU."""
    torch = sys.modules.get("torch")
    if isinstance(error, MemoryError) or (torch is not None and isinstance(error, torch.OutOfMemoryError)):
        return True
    return any(words in str(error) for words in _NO_MEMORY)


def is_broken(error: BaseException) -> bool:
    """Whether CUDA itself failed: whatever this process asks of the GPU from now on fails, too."""
    return "CUDA error" in str(error) and not is_out_of_memory(error)


def empty_cache() -> None:
    """Gives back what torch keeps on a GPU for the next tensor of the same size."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available():
        torch.cuda.empty_cache()


def first_line(error: BaseException) -> str:
    """What an error says at first, at most 200 characters."""
    return str(error).strip().partition("\n")[0][:200]
