"""A stream of scenes for PyTorch's `DataLoader`: every worker of every rank gets its own share."""

from collections.abc import Iterator
from typing import Any

import torch
from torch.utils.data import IterableDataset, get_worker_info

from tableverse_factory.learning.stream import SceneStream


class SceneDataset(IterableDataset):  # type: ignore[misc]
    """A thin cover of a `SceneStream`.

    Scenes differ in size: load them one by one (`batch_size=None`), or with `collate_fn=list`. Its state is that of its
    process, as torchdata's `StatefulDataLoader` asks each worker for it.
    """

    def __init__(
        self, stream: SceneStream, rank: int | None = None, ranks: int | None = None, even: bool = False
    ) -> None:
        """Takes a rank's share.

        Args:
            stream: Of all scenes.
            rank: Of this process; that of `torch.distributed` by default, where it is set up.
            ranks: How many there are.
            even: Leave out the last few scenes of each epoch, so that all ranks are given equally many.

        Raises:
            ConfigError: if there is no such rank.
        """
        together = torch.distributed.is_available() and torch.distributed.is_initialized()
        rank = rank if rank is not None else (torch.distributed.get_rank() if together else 0)
        ranks = ranks if ranks is not None else (torch.distributed.get_world_size() if together else 1)
        self._of_rank = stream.part(rank, ranks, even)
        self._mine = self._of_rank
        self._loaded: dict[str, Any] | None = None

    def __len__(self) -> int:
        return len(self._of_rank)

    def set_epoch(self, epoch: int) -> None:
        """Before the loader is iterated: workers are told when they start."""
        self._of_rank.set_epoch(epoch)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        self._mine = self._share()
        if self._loaded is not None:
            self._mine.load_state_dict(self._loaded)
            self._loaded = None
        return iter(self._mine)

    def state_dict(self) -> dict[str, Any]:
        """Of this process's share."""
        return self._mine.state_dict() if self._loaded is None else self._loaded

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """For the next iteration of this process's share; checked then."""
        self._loaded = state

    def _share(self) -> SceneStream:
        worker = get_worker_info()
        return self._of_rank if worker is None else self._of_rank.part(worker.id, worker.num_workers)
