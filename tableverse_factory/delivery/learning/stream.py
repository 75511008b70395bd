"""Scene streams: each scene once, shuffled by a seed, divisible among workers and ranks, resumable at any item.

The index of scenes is read once, when the stream is made; an item then reads only its own bytes of a shard. Streams are
copied into workers, forked or spawned: each process opens the dataset for itself.
"""

import copy
import hashlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Int64

from schemas.tables import SCENES
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.dataset.query_parser import check_columns, parse_filter
from tableverse_factory.delivery.learning.item_parts import PARTS, check_parts

_INDEX_COLUMNS = ("scene_id", "shard", "tar_offset", "tar_size")
_STATE_KEYS = ("epoch", "given", "part", "order")

Indices = Int64[np.ndarray, " n"]


@dataclass(slots=True)
class _Position:
    """Progress of one iteration."""

    epoch: int
    given: int = 0
    begun: bool = False


class SceneStream:
    """Scenes of a dataset as dictionaries: `scene_id`, the requested columns, and the requested parts.

    Every iteration starts anew, except right after `load_state_dict`; the state is that of the newest iteration. The
    order depends only on the dataset, `condition`, `shuffle`, `seed` and the epoch.
    """

    def __init__(
        self,
        dataset: str | Path,
        parts: Sequence[str] = ("photograph", "labels", "poses"),
        *,
        columns: Sequence[str] = (),
        condition: str = "",
        shuffle: int = 1024,
        seed: int = 0,
    ) -> None:
        """Read the index of scenes.

        Args:
            dataset: As in `open_dataset`.
            parts: Names of `learning.item_parts.PARTS`.
            columns: Columns of scenes/ to add to each item.
            condition: On the columns of scenes/, as in `tableverse query --where`; scenes without files are skipped.
            shuffle: Size of the shuffle buffer (`shuffle_epoch`); 0 keeps the order of the table.
            seed: Of the shuffle.
        """
        if shuffle < 0 or seed < 0:
            raise ConfigError(f"shuffle {shuffle} and seed {seed}: give whole numbers from 0 on")
        self._path, self._parts = str(dataset), check_parts(tuple(parts))
        self._columns = tuple(check_columns(columns, SCENES))
        self._shuffle, self._seed, self._place = shuffle, seed, _Position(0)
        self._part = (0, 1, 1)  # index, of how many, and how many of them are to be equally long
        self._opened: tuple[int, Dataset] | None = None
        self._index = self._read_index(condition)

    def __len__(self) -> int:
        return len(take_part(np.arange(len(self._index)), *self._part))

    def part(self, index: int, of: int, even: bool = False) -> Self:
        """Return a separate stream of every `of`-th item from `index` on, for one of `of` ranks or workers.

        `even` drops the last few scenes of each epoch, so that all parts are equally long.
        """
        if not 0 <= index < of:
            raise ConfigError(f"part {index} of {of}: parts are counted from 0")
        mine, of_all, evened = self._part
        if even and of_all > 1:
            raise ConfigError("a part of a stream cannot be divided evenly: divide the whole")
        other = copy.copy(self)
        other._part = (mine + of_all * index, of_all * of, of if even else evened)
        other._place = _Position(self._place.epoch)
        return other

    def set_epoch(self, epoch: int) -> None:
        """Set the next iteration's epoch: another order of the same scenes, from its first."""
        if epoch < 0:
            raise ConfigError(f"epoch {epoch}: epochs are counted from 0")
        if epoch != self._place.epoch:
            self._place = _Position(epoch)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        if self._place.begun:
            self._place = _Position(self._place.epoch)
        self._place.begun = True
        return self._items(self._place)

    def _items(self, place: _Position) -> Iterator[dict[str, Any]]:
        shards = self._index["shard"].to_numpy().astype(np.int64)
        ordered = take_part(shuffle_epoch(shards, self._seed, place.epoch, self._shuffle), *self._part)
        for number in ordered[place.given :]:
            item = self._item(int(number))
            place.given += 1
            yield item
        place.given = 0

    def state_dict(self) -> dict[str, Any]:
        """Return the position as plain numbers and strings, for checkpoints."""
        place = self._place
        return {"epoch": place.epoch, "given": place.given, "part": list(self._part), "order": self._digest}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume the next iteration at another stream's position."""
        numbers = [state.get(key) if isinstance(state, dict) else None for key in ("epoch", "given")]
        if not all(isinstance(number, int) and number >= 0 for number in numbers):
            raise InputError(f"no state of a stream: it has {', '.join(_STATE_KEYS)}", "bad_state")
        if state.get("order") != self._digest or list(state.get("part", ())) != list(self._part):
            raise InputError(
                "the state is of a stream of other scenes, with another shuffle or seed, or of another part: "
                f"this is part {self._part[0]} of {self._part[1]}, give it the state of the same",
                "bad_state",
            )
        self._place = _Position(int(state["epoch"]), int(state["given"]))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": None, "_place": replace(self._place)}

    def _read_index(self, condition: str) -> pa.Table:
        chosen = pc.field("tar_offset").is_valid() & pc.field("tar_size").is_valid()
        if condition:
            chosen &= parse_filter(condition, SCENES)
        names = list(dict.fromkeys((*_INDEX_COLUMNS, *self._columns)))
        try:
            return self._dataset.scenes.to_table(columns=names, filter=chosen).combine_chunks()
        except (pa.ArrowException, OSError) as error:
            raise InputError(f"{self._path}/scenes: does not read: {sanitize_line(str(error), 300)}") from None

    @property
    def _dataset(self) -> Dataset:
        """Dataset opened by this process, as forks must not share a parent's connections."""
        if self._opened is None or self._opened[0] != os.getpid():
            self._opened = (os.getpid(), open_dataset(self._path))
        return self._opened[1]

    def _item(self, number: int) -> dict[str, Any]:
        row: dict[str, Any] = self._index.slice(number, 1).to_pylist()[0]
        scene = self._dataset.scene_at(row)
        item = {"scene_id": scene.scene_id, **{name: row[name] for name in self._columns}}
        return {**item, **{name: PARTS[name](scene) for name in self._parts}}

    @cached_property
    def _digest(self) -> str:
        """Hash of everything that determines the order."""
        digest = hashlib.sha256(f"{self._shuffle} {self._seed}".encode())
        for scene_id, shard in zip(*(self._index[name].to_pylist() for name in ("scene_id", "shard")), strict=True):
            digest.update(f"\n{shard} {scene_id}".encode())
        return digest.hexdigest()[:16]


def shuffle_epoch(shards: Indices, seed: int, epoch: int, buffer: int) -> Indices:
    """Shuffle all scenes of an epoch: a permutation of 0 to n - 1.

    Shards are shuffled, and a buffer mixes the scenes of consecutive shards: each next scene is drawn from `buffer`
    waiting ones, so that scenes read in succession lie in few shards. With `buffer` 0 the order is that of the table,
    in every epoch. `shards` holds each scene's shard number.
    """
    if buffer == 0:
        return np.arange(len(shards), dtype=np.int64)
    rng = make_rng(seed, "stream", f"epoch {epoch}")
    rank = np.empty(int(shards.max(initial=-1)) + 1, dtype=np.int64)
    present = np.unique(shards)
    rank[present] = rng.permutation(len(present))
    by_shard = np.argsort(rank[shards], kind="stable")
    waiting, rest = by_shard[:buffer].copy(), by_shard[buffer:]
    drawn = np.empty(len(by_shard), dtype=np.int64)
    for position, (slot, following) in enumerate(zip(rng.integers(buffer, size=len(rest)), rest, strict=True)):
        drawn[position], waiting[slot] = waiting[slot], following
    drawn[len(rest) :] = rng.permutation(waiting)
    return drawn


def take_part(ordered: Indices, index: int, of: int, even_for: int = 1) -> Indices:
    """Take every `of`-th scene from `index` on; the parts are disjoint and complete.

    `even_for` drops the last few scenes of the order, fewer than this, so that as many parts are equally long.
    """
    return ordered[: len(ordered) - len(ordered) % even_for][index::of]
