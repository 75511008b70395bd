"""A table of many shards once more in one file: a query opens one file instead of thousands.

`OUT/merged/objects.parquet` holds the rows of all `OUT/objects/shard-*.parquet`, in their order. It is written when a
build ends that has many shards, and removed before a later build computes anything, so it is never part of the truth:
its metadata name the shards and sizes that it was made from, and a reader that finds others reads the shards instead.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from upath import UPath

from schemas.arrow import TABLES
from schemas.identity import content_hash
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import (
    StoragePath,
    atomic_file,
    list_names,
    read_whole,
    remove_folder,
    get_store,
    write_error,
)
from tableverse_factory.core.storage.parquet import PARQUET_OPTIONS, ROW_GROUP
from tableverse_factory.dataset.shards import SPARSE, read_shard, shard_path

MERGED = "merged"
MANY_SHARDS = 16
"""Datasets of so many shards or fewer have no merged tables: they would gain nothing."""

MADE_FROM = b"tableverse.shards"
"""Key of the metadata that names what a merged table was made from (see `digest_shards`)."""


def merged_path(out: StoragePath, table: str) -> StoragePath:
    """Where the merged table stands, e.g. `OUT/merged/objects.parquet`."""
    return out / MERGED / f"{table}.parquet"


def digest_shards(sizes: Mapping[str, int]) -> bytes:
    """What a merged table says it was made from.

    Args:
        sizes: Names of the table's shards with their sizes [bytes].
    """
    return content_hash("".join(f"{name} {sizes[name]}\n" for name in sorted(sizes)).encode()).encode()


def write_merged_tables(out: StoragePath, n_shards: int) -> None:
    """Merges the tables of a finished dataset of many shards; leaves those that are right already as they are.

    Memory holds one row group and one shard; the same shards give the same bytes.

    Raises:
        BuildError: if a shard is missing or damaged, or the disk or the store refuses.
    """
    if n_shards <= MANY_SHARDS:
        return
    for table, schema in TABLES.items():
        sizes = _sizes(out, table, n_shards)
        source = digest_shards(sizes)
        path = merged_path(out, table)
        if sizes and _source_of(path) != source:
            with atomic_file(path) as file:
                writer = pq.ParquetWriter(file, schema, **PARQUET_OPTIONS)
                _write(writer, out, table, sorted(sizes))
                writer.add_key_value_metadata({MADE_FROM.decode(): source.decode()})
                writer.close()


def remove_merged_tables(out: StoragePath) -> None:
    """Removes the merged tables, before the first shard changes.

    Raises:
        BuildError: if the disk or the store refuses.
    """
    remove_folder(out / MERGED)


def _write(writer: pq.ParquetWriter, out: StoragePath, table: str, names: Sequence[str]) -> None:
    """All shards in row groups of one size, whatever the sizes of the shards are."""
    schema = TABLES[table]
    parts: list[pa.Table] = []
    for name in names:
        parts.append(read_shard(out / table / name, schema))
        if sum(part.num_rows for part in parts) >= ROW_GROUP or name == names[-1]:
            rows = pa.concat_tables(parts).combine_chunks()
            whole = rows.num_rows if name == names[-1] else rows.num_rows // ROW_GROUP * ROW_GROUP
            writer.write_table(rows.slice(0, whole), ROW_GROUP)
            parts = [rows.slice(whole)]


def _sizes(out: StoragePath, table: str, n_shards: int) -> dict[str, int]:
    folder = out / table
    if table in SPARSE and not list_names(folder):
        return {}
    try:
        sizes = (
            get_store(folder).list_sizes(folder.path)
            if isinstance(folder, UPath)
            else {path.name: path.stat().st_size for path in folder.iterdir()}
        )
    except OSError as error:
        raise write_error(folder, error) from error
    names = [shard_path(out, table, number).name for number in range(n_shards)]
    if table in SPARSE:
        names = [name for name in names if name in sizes]
    if missing := [name for name in names if name not in sizes]:
        raise BuildError(f"{folder / missing[0]} is missing although its shard is committed")
    return {name: sizes[name] for name in names}


def _source_of(path: StoragePath) -> bytes | None:
    """What the merged table at `path` was made from; None where there is none that can be read."""
    try:
        source = pa.BufferReader(read_whole(path)) if isinstance(path, UPath) else Path(path)
        found: bytes | None = (pq.read_metadata(source).metadata or {}).get(MADE_FROM)
    except (OSError, pa.ArrowException):
        return None
    return found
