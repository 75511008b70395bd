"""Scene streams for PyTorch's `DataLoader`, shared out to the workers of every rank."""

import os
from collections.abc import Iterator
from typing import Any

import torch
from torch.utils.data import IterableDataset, get_worker_info

from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.delivery.learning.stream import SceneStream


class SceneDataset(IterableDataset):  # type: ignore[misc]
    """Thin `IterableDataset` over a `SceneStream`.

    Scenes differ in size: load them one by one (`batch_size=None`), or with `collate_fn=list`. Its state is that of its
    process, as torchdata's `StatefulDataLoader` expects of each worker.
    """

    def __init__(
        self, stream: SceneStream, rank: int | None = None, ranks: int | None = None, even: bool = False
    ) -> None:
        """Take a rank's share of a stream of all scenes.

        By default `rank` and `ranks` are those of `torch.distributed` when a loader is iterated. `even` drops the last
        few scenes of each epoch, so that all ranks get equally many.
        """
        if (rank is None) != (ranks is None):
            raise ConfigError(f"rank {rank} of ranks {ranks}: give both or neither")
        self._division = None if rank is None or ranks is None else (rank, ranks)
        self._whole, self._even = stream.part(0, 1), even
        self._whole.part(*(self._division or (0, 1)), even)  # what is no part is said here, not in a worker
        self._here: tuple[int, SceneStream] | None = None  # what this process iterates; forks inherit their parent's
        self._loaded: dict[str, Any] | None = None

    def __len__(self) -> int:
        return len(self._of_rank())

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, before the loader is iterated, as workers receive it when they start."""
        self._whole.set_epoch(epoch)
        if self._here is not None:
            self._here[1].set_epoch(epoch)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Iterate this process's share."""
        worker, share = get_worker_info(), self._of_rank()
        if worker is not None:
            if self._iterated() is not None:
                return _refuse_persistent_worker()
            share = share.part(worker.id, worker.num_workers)
        if self._loaded is not None:
            _resume(share, self._loaded)
            self._loaded = None
        self._here = (os.getpid(), share)
        return iter(share)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of this process's share; ConfigError where it iterated nothing, as with workers."""
        if self._loaded is not None:
            return self._loaded
        share = self._iterated()
        if share is None:
            raise ConfigError(
                "no state: nothing was iterated in this process, and workers keep their own: "
                "give num_workers=0, or take torchdata's StatefulDataLoader"
            )
        return share.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a state at the next iteration, in the state's own epoch (`set_epoch`); checked then."""
        self._loaded = state

    def __getstate__(self) -> dict[str, Any]:
        """Resolve the rank for a spawned worker, which has no `torch.distributed`."""
        return {**self.__dict__, "_division": self._division or _get_rank(), "_here": None}

    def _of_rank(self) -> SceneStream:
        division = self._division or _get_rank()
        if division is None and (size := os.environ.get("WORLD_SIZE", "1")) != "1":
            raise ConfigError(f"WORLD_SIZE is {size}, but no process group is set up: do, or give rank and ranks")
        return self._whole.part(*(division or (0, 1)), self._even)

    def _iterated(self) -> SceneStream | None:
        return self._here[1] if self._here is not None and self._here[0] == os.getpid() else None


def _refuse_persistent_worker() -> Iterator[dict[str, Any]]:
    """Raise at the first item, as an earlier error would end a persistent worker silently."""
    yield from ()
    raise ConfigError("persistent_workers=True: workers that stay never hear of set_epoch; give False")


def _get_rank() -> tuple[int, int] | None:
    """Return this process's rank in `torch.distributed`, and the number of ranks."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return None


def _resume(share: SceneStream, state: dict[str, Any]) -> None:
    """Resume a share; a state at the beginning or end of another epoch changes nothing."""
    epoch = share.state_dict()["epoch"]
    share.load_state_dict(state)
    if 0 < state["given"] < len(share) and state["epoch"] != epoch:
        raise InputError(
            f"the state is in the midst of epoch {state['epoch']}, and the dataset is at epoch {epoch}: "
            f"set_epoch({state['epoch']}) before, to go on",
            "bad_state",
        )
    share.set_epoch(epoch)
