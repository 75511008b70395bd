"""Search index of the scenes of a dataset: ids, names and statuses; labels are read at the first search."""

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
MAX_SEARCH = 200  # characters of a search; longer ones are cut


class SearchHits:
    """Scenes that a search found, in the order of the dataset."""

    def __init__(self, scene_ids: Sequence[str]) -> None:
        self.scene_ids = scene_ids

    def __len__(self) -> int:
        return len(self.scene_ids)

    def page(self, current: str, size: int) -> list[str]:
        """Return the page of `size` scenes that holds the current one; the first page if it was not found."""
        start = max(self.position(current), 0) // size * size
        return list(self.scene_ids[start : start + size])

    def position(self, scene_id: str) -> int:
        """Return the index of a scene; -1 if it was not found."""
        return self._positions.get(scene_id, -1)

    def step_from(self, current: str, step: int) -> str | None:
        """Return the scene `step` positions further, at most to either end; the first if the current was not found."""
        if not self.scene_ids:
            return None
        position = self.position(current)
        if position < 0:
            return self.scene_ids[0]
        return self.scene_ids[min(max(position + step, 0), len(self.scene_ids) - 1)]

    @cached_property
    def _positions(self) -> dict[str, int]:
        return {scene_id: index for index, scene_id in enumerate(self.scene_ids)}


class SceneIndex:
    """The scenes of a dataset."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._scenes = self._read(dataset.scenes, ["scene_id", "name", "status"])
        self._ids: list[str] = self._scenes["scene_id"].to_pylist()

    def __len__(self) -> int:
        return len(self._ids)

    def search(self, text: str = "", status: str = ANY) -> SearchHits:
        """Find scenes of a status for which every word, in any case, is in the id, the name or an object's label."""
        matches = pa.chunked_array([pa.array([True] * len(self._ids), pa.bool_())])
        if status != ANY:
            matches = pc.and_(matches, pc.equal(self._scenes["status"], status))
        for word in text[:MAX_SEARCH].split():
            named = pc.or_(_contains(self._scenes["scene_id"], word), _contains(self._scenes["name"], word))
            labelled = pc.is_in(self._scenes["scene_id"], value_set=self._find_labelled(word))
            matches = pc.and_(matches, pc.or_(named, labelled))
        return SearchHits(self._scenes["scene_id"].filter(matches).to_pylist())

    def has_files(self, scene_id: str) -> bool:
        """Check that a scene is not listed as dropped or failed."""
        return scene_id not in self._dropped

    def first(self) -> str | None:
        """Return the first finished scene, else the first of any status; None for an empty dataset."""
        done = self.search(status="done")
        return done.scene_ids[0] if len(done) else (self._ids[0] if self._ids else None)

    def _find_labelled(self, word: str) -> pa.Array:
        objects = self._objects
        matches = pc.or_(_contains(objects["label"], word), _contains(objects["relabel_name"], word))
        return pc.unique(objects["scene_id"].filter(matches)).cast(pa.string())

    @cached_property
    def _dropped(self) -> frozenset[str]:
        dropped = pc.not_equal(self._scenes["status"], "done")
        return frozenset(self._scenes["scene_id"].filter(dropped).to_pylist())

    @cached_property
    def _objects(self) -> pa.Table:
        return self._read(self._dataset.objects, ["scene_id", "label", "relabel_name"])

    def _read(self, table: Any, columns: list[str]) -> pa.Table:
        try:
            return table.to_table(columns=columns)
        except (pa.ArrowException, OSError) as error:
            raise InputError(f"{self._dataset.path}: cannot be read: {sanitize_line(str(error), 300)}") from None


def _contains(column: pa.ChunkedArray, word: str) -> pa.ChunkedArray:
    return pc.fill_null(pc.match_substring(column, word, ignore_case=True), False)
