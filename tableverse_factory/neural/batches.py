"""Items through a model in batches of one shape, smaller ones where the memory does not do."""

import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

from tableverse_factory.errors import ModelError

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def in_batches(run: Callable[[Sequence[_Item]], Sequence[_Result]], items: Sequence[_Item], size: int) -> list[_Result]:
    """What a model says of each item, in their order.

    Every call gets exactly as many items, the last one filled up with its own last item: kernels are chosen by shape,
    so a result does not depend on how many others were there. Where the memory is not enough, the size is halved for
    what is left; only then may the last digits differ.

    Args:
        run: Answers a batch, one result for each item.
        items: Any number of them.
        size: Items in a batch, at least 1.

    Raises:
        ModelError: if not even one item fits.
    """
    results: list[_Result] = []
    while len(results) < len(items):
        part = list(items[len(results) : len(results) + size])
        full = part + [part[-1]] * (size - len(part))
        try:
            answers = run(full)
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            if size == 1:
                raise ModelError(f"one item is too much for the memory of the model: {_first_line(error)}") from None
            answers = None
        if answers is None:  # outside of `except`, where the error would keep the failed forward's tensors alive
            size = max(1, size // 2)
            empty_cache()
            continue
        if len(answers) != size:
            raise ModelError(f"a model gave {len(answers)} answers to {size} items")
        results += answers[: len(part)]
    return results


def is_out_of_memory(error: BaseException) -> bool:
    """Whether torch found no memory, on a GPU or on the CPU."""
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(error, torch.OutOfMemoryError):
        return True
    said = str(error)
    return "DefaultCPUAllocator" in said or "can't allocate memory" in said or "CUDA out of memory" in said


def empty_cache() -> None:
    """Gives back what torch keeps on a GPU for the next tensor of the same size."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available():
        torch.cuda.empty_cache()


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0][:200]
