"""Rows of the scenes that are accounted for, from committed shards and from the journals of open ones."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc

from schemas.tables import SCENES, TIMINGS
from schemas.work import SceneResult
from tableverse_factory.core.storage.files import StoragePath, list_names
from tableverse_factory.dataset.committed_rows import map_parts, read_shard
from tableverse_factory.dataset.journals import WORK, find_journals, journal_path, read_journal, read_result
from tableverse_factory.dataset.model_costs import make_cost_columns
from tableverse_factory.dataset.shards import committed_shards, is_committed

_ATTEMPTS = 4
_RESULT_FIELDS = ("scene_id", "status", "stage", "reason", "error_kind", "detail", "attempts")

_Listing = tuple[frozenset[int], frozenset[int]]  # shards with a journal, and published ones, listed in this order


class ShardRows(NamedTuple):
    """Rows of one shard or of several, in columns of `schemas.tables.SCENES` and `TIMINGS`."""

    scenes: pa.Table  # that are accounted for: those of a journal, then committed ones; `tar_size` is null in a journal
    timings: pa.Table  # of these scenes
    stored: pa.Table  # rows of published shards, also of scenes to recompute
    whole: int = 0  # number of shards that are whole


class ShardReader:
    """Reader of shards while a build may commit or rewrite them."""

    def __init__(self, out: StoragePath, columns: Sequence[str], timing_columns: Sequence[str]) -> None:
        """Only these columns of scenes and timings are read, which saves most of the time where there are few."""
        self._out, self._columns, self._timing_columns = out, columns, timing_columns
        nothing = _make_table((), SCENES, columns)
        self._nothing = ShardRows(nothing, _make_table((), TIMINGS, timing_columns), nothing)

    def read(self, shards: range) -> ShardRows:
        """Read consecutive shards, in their order."""
        listing = self._list()
        there = self.list_shards(shards, listing)
        return self.join(map_parts(lambda part: self._read_part(part, listing), self._out, there))

    def list_shards(self, shards: range, listing: _Listing | None = None) -> list[int]:
        """List those of the shards that have a journal or are published."""
        journals, published = self._list() if listing is None else listing
        return sorted(shard for shard in journals | published if shard in shards)

    def _list(self) -> _Listing:
        return find_journals(list_names(self._out / WORK)), committed_shards(self._out)

    def join(self, parts: Iterable[ShardRows]) -> ShardRows:
        """Join rows, because thousands of small tables take more memory than one."""
        scenes, timings, stored, whole = zip(self._nothing, *parts, strict=True)
        joined, times = _join_tables(scenes), _join_tables(timings)
        same = all(own is other for own, other in zip(scenes, stored, strict=True))
        return ShardRows(joined, times, joined if same else _join_tables(stored), sum(whole))

    def _read_part(self, shards: Sequence[int], listing: _Listing) -> ShardRows:
        return self.join([self._read_with_retries(shard, listing) for shard in shards])

    def _read_with_retries(self, shard: int, listing: _Listing) -> ShardRows:
        for _ in range(_ATTEMPTS):
            try:
                return self._read_shard(shard, listing)
            except FileNotFoundError:  # committed meanwhile: list again
                listing = self._list()
        return self._read_shard(shard, listing)

    def _read_shard(self, shard: int, listing: _Listing) -> ShardRows:
        """Read a shard: results in its journal take precedence over committed rows."""
        journals, published = listing
        if shard not in journals:
            if shard not in published:
                return self._nothing
            scenes, timings, stored = read_committed_shard(self._out, shard, self._columns, self._timing_columns)
            return ShardRows(scenes, timings, stored, 1)
        path = journal_path(self._out, shard)
        journal = read_journal(path)
        if shard not in published and not journal.results and is_committed(self._out, shard):
            raise FileNotFoundError(str(path))
        results = (read_result(path, entry) for entry in journal.results.values())
        open_rows = self._tabulate(results, shard)
        if shard not in published:
            return open_rows
        kept = self._read_kept(shard, journal.reopened | set(journal.results))
        return self.join([open_rows, kept])._replace(whole=int(not journal.reopened))

    def _read_kept(self, shard: int, replaced: Iterable[str]) -> ShardRows:
        """Read a published shard, whose replaced scenes only count as stored."""
        columns, timing_columns = ({"scene_id": 0, **dict.fromkeys(c)} for c in (self._columns, self._timing_columns))
        *valid, stored = read_committed_shard(self._out, shard, [*columns], [*timing_columns])
        gone = pa.array(sorted(replaced), pa.string())
        scenes, timings = (table.filter(pc.invert(pc.is_in(table["scene_id"], gone))) for table in valid)
        names = list(self._columns)
        return ShardRows(scenes.select(names), timings.select(list(self._timing_columns)), stored.select(names))

    def _tabulate(self, results: Iterable[SceneResult], shard: int) -> ShardRows:
        """Make the rows of results of a journal."""
        scenes: list[Mapping[str, Any]] = []
        timings: list[Mapping[str, Any]] = []
        for result in results:
            own = {name: getattr(result, name) for name in _RESULT_FIELDS}
            scenes.append({**own, "kind": result.row.kind.value, "shard": shard, **make_cost_columns(result.costs)})
            timings += [{name: getattr(t, name, result.scene_id) for name in TIMINGS.names} for t in result.timings]
        rows = _make_table(scenes, SCENES, self._columns), _make_table(timings, TIMINGS, self._timing_columns)
        return ShardRows(*rows, self._nothing.stored)


def read_committed_shard(
    out: StoragePath, shard: int, columns: Sequence[str], timing_columns: Sequence[str]
) -> tuple[pa.Table, pa.Table, pa.Table]:
    """Read scenes, timings, and scenes as they are stored; FileNotFoundError if the shard is being replaced."""
    timings = read_shard(out, "timings", shard, timing_columns)
    stored = read_shard(out, "scenes", shard, columns)
    if "tar_size" not in columns:
        return stored, timings, stored
    sizes = stored["tar_size"].fill_null(0)  # a scene without files takes none
    return stored.set_column(list(columns).index("tar_size"), "tar_size", sizes), timings, stored


def _join_tables(tables: Iterable[pa.Table]) -> pa.Table:
    return pa.concat_tables(tables).combine_chunks()


def _make_table(rows: Sequence[Mapping[str, Any]], schema: pa.Schema, columns: Iterable[str]) -> pa.Table:
    return pa.Table.from_pylist(list(rows), schema=pa.schema([schema.field(name) for name in columns]))
