"""The scenes of a dataset to choose from: three columns at first, labels when somebody searches for one."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Dataset

ANY = "any"
STATUSES = (ANY, "done", "dropped", "failed")
MAX_SEARCH = 200
"""Longer searches are cut."""


class SearchHits:
    """Scenes that a search found, in the order of the dataset."""

    def __init__(self, scene_ids: Sequence[str]) -> None:
        """Keeps them.

        Args:
            scene_ids: Each once.
        """
        self.scene_ids = scene_ids

    def __len__(self) -> int:
        return len(self.scene_ids)

    def window(self, current: str, size: int) -> list[str]:
        """The page of `size` scenes on which one lies; the first where it was not found."""
        start = self.place(current) // size * size if self.place(current) >= 0 else 0
        return list(self.scene_ids[start : start + size])

    def place(self, scene_id: str) -> int:
        """Its number, from 0 on; -1 where it was not found."""
        return self._places.get(scene_id, -1)

    def beside(self, current: str, step: int) -> str | None:
        """So many scenes further, at most to either end; the first, from one that was not found; None in no list."""
        if not self.scene_ids:
            return None
        place = self.place(current)
        if place < 0:
            return self.scene_ids[0]
        return self.scene_ids[min(max(place + step, 0), len(self.scene_ids) - 1)]

    @cached_property
    def _places(self) -> dict[str, int]:
        return {scene_id: place for place, scene_id in enumerate(self.scene_ids)}


class Catalogue:
    """What there is in a dataset."""

    def __init__(self, dataset: Dataset) -> None:
        """Reads ids, names and statuses.

        Raises:
            InputError: if the table of scenes does not read.
        """
        self._dataset = dataset
        self._scenes = self._read(dataset.scenes, ["scene_id", "name", "status"])
        self._ids: list[str] = self._scenes["scene_id"].to_pylist()

    def __len__(self) -> int:
        return len(self._ids)

    def search(self, text: str = "", status: str = ANY) -> SearchHits:
        """Scenes of a status whose id or name, or the label of one of whose objects, holds every word of a text.

        Args:
            text: Words in any letters; all of them must be found, each wherever it stands.
            status: One of `STATUSES`.
        """
        kept = pa.chunked_array([pa.array([True] * len(self._ids), pa.bool_())])
        if status != ANY:
            kept = pc.and_(kept, pc.equal(self._scenes["status"], status))
        for word in text[:MAX_SEARCH].split():
            named = pc.or_(_holds(self._scenes["scene_id"], word), _holds(self._scenes["name"], word))
            labelled = pc.is_in(self._scenes["scene_id"], value_set=self._labelled(word))
            kept = pc.and_(kept, pc.or_(named, labelled))
        return SearchHits(self._scenes["scene_id"].filter(kept).to_pylist())

    def has_files(self, scene_id: str) -> bool:
        """Whether a scene can be opened; so far as the list says, also one that is not in it."""
        return scene_id not in self._lost

    def first(self) -> str | None:
        """The first scene that can be opened; any, where none can; None in an empty dataset."""
        done = self.search(status="done")
        return done.scene_ids[0] if len(done) else (self._ids[0] if self._ids else None)

    def _labelled(self, word: str) -> pa.Array:
        objects = self._objects
        held = pc.or_(_holds(objects["label"], word), _holds(objects["relabel_name"], word))
        return pc.unique(objects["scene_id"].filter(held)).cast(pa.string())

    @cached_property
    def _lost(self) -> frozenset[str]:
        lost = pc.not_equal(self._scenes["status"], "done")
        return frozenset(self._scenes["scene_id"].filter(lost).to_pylist())

    @cached_property
    def _objects(self) -> pa.Table:
        return self._read(self._dataset.objects, ["scene_id", "label", "relabel_name"])

    def _read(self, table: Any, columns: list[str]) -> pa.Table:
        try:
            return table.to_table(columns=columns)
        except (pa.ArrowException, OSError) as error:
            raise InputError(f"{self._dataset.path}: does not read: {sanitize_line(str(error), 300)}") from None


def _holds(column: pa.ChunkedArray, word: str) -> pa.ChunkedArray:
    return pc.fill_null(pc.match_substring(column, word, ignore_case=True), False)
