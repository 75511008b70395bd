"""Processes of one training, a GPU each, that average their gradients and agree when to save and to stop."""

import multiprocessing
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import ModelError
from tableverse_factory.core.process_pool import prepare_child
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

PATIENCE = timedelta(minutes=8)  # for a process that starts, or that measures held-out views
SEED_STEP = 1_000_003  # between the seeds of two processes
LOOPBACK = {"GLOO_SOCKET_IFNAME": "lo", "NCCL_SOCKET_IFNAME": "lo"}


@dataclass(frozen=True, slots=True, eq=False)
class Ranks:
    """This process among those of a training; alone, it does nothing.

    Attributes:
        rank: Of this process; the first one, 0, saves and logs.
        size: Number of processes.
        control: Group that exchanges words on the CPU; None alone.
        others: The processes that the first one started.
    """

    rank: int = 0
    size: int = 1
    control: Any = None
    others: tuple[BaseProcess, ...] = ()

    def shift_seed(self, seed: int) -> int:
        """Give each process a seed of its own, the first one `seed` itself."""
        return seed + SEED_STEP * self.rank

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its mean over the processes."""
        if self.size == 1:
            return
        flat = torch.cat([each.detach().flatten() for each in tensors])
        torch.distributed.all_reduce(flat)
        flat /= self.size
        parts = flat.split([each.numel() for each in tensors])
        with torch.no_grad():
            torch._foreach_copy_(list(tensors), [p.view_as(t) for p, t in zip(parts, tensors, strict=True)])

    def agree(self, *flags: bool) -> tuple[bool, ...]:
        """Return the flags of the first process.

        Raises:
            ModelError: if another process has ended.
        """
        if self.size == 1:
            return flags
        for number, each in enumerate(self.others, start=1):
            if not each.is_alive():
                raise ModelError(f"process {number} of the training ended with {each.exitcode}: it says why above")
        word = torch.tensor(flags, dtype=torch.uint8)
        torch.distributed.broadcast(word, 0, group=self.control)
        return tuple(bool(each) for each in word)

    def gather(self, item: Any) -> list[Any]:
        """Collect the item of each process, in their order."""
        if self.size == 1:
            return [item]
        items: list[Any] = [None] * self.size
        torch.distributed.all_gather_object(items, item, group=self.control)
        return items


@contextmanager
def start_ranks(size: int, device: str, work: Callable[..., object], *arguments: object) -> Iterator[Ranks]:
    """Start `work(*arguments, ranks)` in all processes but this one, the first; they end with it."""
    if size == 1:
        yield Ranks()
        return
    with tempfile.TemporaryDirectory(prefix="tableverse_ranks_") as folder:
        meeting = Path(folder) / "meeting"
        context = multiprocessing.get_context("spawn")
        others = tuple(
            context.Process(target=_run_rank, args=(rank, size, device, meeting, work, arguments))
            for rank in range(1, size)
        )
        try:
            for each in others:
                each.start()
            control = _join(0, size, device, meeting)
            yield Ranks(0, size, control, others)
            torch.distributed.destroy_process_group()
            for each in others:
                each.join(PATIENCE.total_seconds())
        finally:
            for each in others:
                if each.pid is not None:
                    each.kill()
            if torch.distributed.is_initialized():
                torch.distributed.destroy_process_group()


def _run_rank(
    rank: int, size: int, device: str, meeting: Path, work: Callable[..., object], arguments: tuple[object, ...]
) -> None:
    prepare_child()
    control = _join(rank, size, device, meeting)
    work(*arguments, Ranks(rank, size, control))
    torch.distributed.destroy_process_group()


def _join(rank: int, size: int, device: str, meeting: Path) -> Any:
    """Join the others through a file; what they exchange stays on this machine. Return the group on the CPU."""
    os.environ.update({name: os.environ.get(name, value) for name, value in LOOPBACK.items()})
    if device == "cuda":
        torch.cuda.set_device(rank)
    torch.distributed.init_process_group(
        "nccl" if device == "cuda" else "gloo",
        store=torch.distributed.FileStore(str(meeting), size),
        rank=rank,
        world_size=size,
        timeout=PATIENCE,
    )
    return torch.distributed.new_group(backend="gloo", timeout=PATIENCE)
