"""Parquet: tables written with fixed bytes, and read from the disk, a store or a server.

Arrow reads such files through Python, in threads of its own. Where the interpreter ends while one of them lets go of a
file, the process dies by a signal after all its work is done (apache/arrow issue 39862). So files that Arrow was given
are waited for when the interpreter ends, and what is small is read without its threads.
"""

import atexit
import time
from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from typing import Any
from weakref import WeakSet

import fsspec
import pyarrow as pa
import pyarrow.fs
import pyarrow.parquet as pq
from upath import UPath

from tableverse_factory.core.storage.files import StoragePath, read_whole

ROW_GROUP = 64 * 1024
PARQUET_OPTIONS: dict[str, Any] = {"compression": "zstd", "version": "2.6"}
"""Options that affect the bytes of a Parquet file."""

_READ_AHEAD_BYTES = 64 * 1024  # Read-ahead beyond what Arrow asks for; s3fs would read 50 MB
_MAX_WAIT_S = 1.0
_OPEN_FILES: WeakSet[Any] = WeakSet()


def build_table(rows: Iterable[Mapping[str, Any]], schema: pa.Schema) -> pa.Table:
    """Build a table of that schema; columns that a row lacks are null."""
    return pa.Table.from_pylist(list(rows), schema=schema)


def encode_parquet(table: pa.Table) -> bytes:
    """Encode a table as Parquet: the same bytes for the same rows and the same pyarrow."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, row_group_size=ROW_GROUP, **PARQUET_OPTIONS)
    return bytes(sink.getvalue())


def encode_rows(rows: Iterable[Mapping[str, Any]], schema: pa.Schema) -> bytes:
    """Encode rows to the bytes of `encode_parquet(build_table(rows, schema))`, one row group in memory at a time."""
    sink, rows = pa.BufferOutputStream(), iter(rows)
    group = list(islice(rows, ROW_GROUP))
    with pq.ParquetWriter(sink, schema, **PARQUET_OPTIONS) as writer:
        writer.write_table(build_table(group, schema), row_group_size=ROW_GROUP)  # an empty one, too
        while group := list(islice(rows, ROW_GROUP)):
            writer.write_table(build_table(group, schema), row_group_size=ROW_GROUP)
    return bytes(sink.getvalue())


def open_parquet(path: StoragePath) -> pq.ParquetFile:
    """Open a Parquet file, which a store sends whole."""
    source = pa.BufferReader(read_whole(path)) if isinstance(path, UPath) else path
    return pq.ParquetFile(source, pre_buffer=False)


def read_table(path: StoragePath, schema: pa.Schema | None = None, columns: Sequence[str] | None = None) -> pa.Table:
    """Read a Parquet file, or some columns of it, in this thread; columns of `schema` that it lacks are null."""
    with open_parquet(path) as file:
        table = file.read(None if columns is None else list(columns), use_threads=False)
    if schema is None:
        return table
    wanted = schema if columns is None else pa.schema([schema.field(name) for name in columns])
    if table.schema.equals(wanted):
        return table
    there, nothing = set(table.column_names), pa.nulls(table.num_rows)
    arrays = [
        (table[name] if name in there else nothing).cast(kind)
        for name, kind in zip(wanted.names, wanted.types, strict=True)
    ]
    return pa.Table.from_arrays(arrays, schema=wanted)


class _TrackingHandler(pa.fs.FSSpecHandler):  # type: ignore[misc]
    """Opens files for Arrow and tracks which are still open."""

    def open_input_file(self, path: str) -> pa.NativeFile:
        file = self.fs.open(path, mode="rb", block_size=_READ_AHEAD_BYTES)
        _OPEN_FILES.add(file)
        return pa.PythonFile(file, mode="r")


def make_arrow_filesystem(filesystem: fsspec.AbstractFileSystem) -> pa.fs.FileSystem:
    """Wrap a file system for Arrow."""
    return pa.fs.PyFileSystem(_TrackingHandler(filesystem))


def read_remote_table(
    filesystem: fsspec.AbstractFileSystem, path: str, schema: pa.Schema, columns: Sequence[str] | None = None
) -> pa.Table:
    """Read a small remote Parquet file in one request; columns of the schema that the file lacks are null."""
    names = list(columns or schema.names)
    wanted = pa.schema([schema.field(name) for name in names])
    with pq.ParquetFile(pa.BufferReader(filesystem.cat_file(path)), pre_buffer=False) as file:
        present = [name for name in names if name in file.schema_arrow.names]
        table = file.read(present, use_threads=False)
    return pa.concat_tables([wanted.empty_table(), table], promote_options="default").cast(wanted)


@atexit.register
def _wait_for_open_files() -> None:
    until = time.monotonic() + _MAX_WAIT_S
    while _OPEN_FILES and time.monotonic() < until:
        time.sleep(0.005)
