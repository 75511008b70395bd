"""Consolidated tables: the rows of many shards in one file, so that a query opens one file instead of thousands.

`OUT/merged/objects.parquet` holds the rows of all `OUT/objects/shard-*.parquet`, in their order. It is written when a
build of many shards ends, and removed before a later build computes anything. It is never authoritative: its metadata
name the shards and sizes that it was made from, and a reader that finds others reads the shards instead.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from upath import UPath

from schemas.identity import content_hash
from schemas.tables import TABLES
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import StoragePath, atomic_file, list_sizes, read_whole, remove_folder
from tableverse_factory.core.storage.parquet import PARQUET_OPTIONS, ROW_GROUP
from tableverse_factory.dataset.committed_rows import read_shard
from tableverse_factory.dataset.shards import SPARSE, shard_name, shard_stem

MERGED = "merged"
MANY_SHARDS = 16  # up to this number of shards a dataset has no merged tables, which would gain nothing
MADE_FROM = b"tableverse.shards"  # metadata key of the digest of a merged table's shards (`digest_shards`)


def merged_path(out: StoragePath, table: str) -> StoragePath:
    """Path of a merged table, e.g. `OUT/merged/objects.parquet`."""
    return out / MERGED / f"{table}.parquet"


def digest_shards(sizes: Mapping[str, int]) -> bytes:
    """Digest the names and sizes [bytes] of a table's shards."""
    return content_hash("".join(f"{name} {sizes[name]}\n" for name in sorted(sizes)).encode()).encode()


def write_merged_tables(out: StoragePath, n_shards: int) -> None:
    """Merge the tables of a finished dataset of many shards, except those that are up to date.

    Memory holds one row group and one shard; the same shards give the same bytes.
    """
    if n_shards <= MANY_SHARDS:
        return
    for table, schema in TABLES.items():
        sizes = _list_shard_sizes(out, table, n_shards)
        source = digest_shards(sizes)
        path = merged_path(out, table)
        if sizes and _read_source(path) != source:
            shards = sorted((n for n in range(n_shards) if shard_name(table, n) in sizes), key=shard_stem)
            with atomic_file(path) as file:
                writer = pq.ParquetWriter(file, schema, **PARQUET_OPTIONS)
                _write_shards(writer, out, table, shards)
                writer.add_key_value_metadata({MADE_FROM.decode(): source.decode()})
                writer.close()


def remove_merged_tables(out: StoragePath) -> None:
    """Remove the merged tables, before the first shard changes."""
    remove_folder(out / MERGED)


def _write_shards(writer: pq.ParquetWriter, out: StoragePath, table: str, shards: Sequence[int]) -> None:
    """Write all shards in row groups of one size, whatever the sizes of the shards are."""
    parts: list[pa.Table] = []
    for number in shards:
        parts.append(read_shard(out, table, number))
        is_last = number == shards[-1]
        if sum(part.num_rows for part in parts) >= ROW_GROUP or is_last:
            rows = pa.concat_tables(parts).combine_chunks()
            whole = rows.num_rows if is_last else rows.num_rows // ROW_GROUP * ROW_GROUP
            writer.write_table(rows.slice(0, whole), ROW_GROUP)
            parts = [rows.slice(whole)]


def _list_shard_sizes(out: StoragePath, table: str, n_shards: int) -> dict[str, int]:
    sizes, names = list_sizes(out / table), [shard_name(table, number) for number in range(n_shards)]
    missing = [name for name in names if name not in sizes]
    if missing and table not in SPARSE:
        raise BuildError(f"{out / table / missing[0]} is missing although its shard is committed")
    return {name: sizes[name] for name in names if name in sizes}


def _read_source(path: StoragePath) -> bytes | None:
    """Read the digest of what a merged table was made from; None if there is no readable table."""
    try:
        source = pa.BufferReader(read_whole(path)) if isinstance(path, UPath) else Path(path)
        found: bytes | None = (pq.read_metadata(source).metadata or {}).get(MADE_FROM)
    except (OSError, pa.ArrowException):
        return None
    return found
