"""Parquet files that lie elsewhere: small ones whole, large ones by the ranges that Arrow asks for.

Arrow reads such files through Python, in threads of its own. Where the interpreter ends while one of them lets go of a
file, the process dies by a signal after all its work is done (apache/arrow issue 39862). So files that Arrow was given
are waited for when the interpreter ends, and what is small is read without its threads.
"""

import atexit
import time
from collections.abc import Sequence
from typing import Any
from weakref import WeakSet

import fsspec
import pyarrow as pa
import pyarrow.fs
import pyarrow.parquet as pq

_AHEAD_BYTES = 64 * 1024
"""At most so much more is read than Arrow asks for, where a file system reads ahead; s3fs would read 50 MB."""

_LONGEST_S = 1.0
_LENT: WeakSet[Any] = WeakSet()


class _Files(pa.fs.FSSpecHandler):  # type: ignore[misc]
    """Opens files for Arrow and remembers them while they live."""

    def open_input_file(self, path: str) -> pa.NativeFile:
        file = self.fs.open(path, mode="rb", block_size=_AHEAD_BYTES)
        _LENT.add(file)
        return pa.PythonFile(file, mode="r")


def arrow_filesystem(filesystem: fsspec.AbstractFileSystem) -> pa.fs.FileSystem:
    """The file system as Arrow takes it."""
    return pa.fs.PyFileSystem(_Files(filesystem))


def read_small(
    filesystem: fsspec.AbstractFileSystem, path: str, schema: pa.Schema, columns: Sequence[str] | None = None
) -> pa.Table:
    """A table of one small file, in one request.

    Args:
        filesystem: Where it lies.
        path: Of the file.
        schema: Columns that the file lacks are null.
        columns: Some of them; all without.

    Raises:
        FileNotFoundError: if there is none.
        OSError: if it does not read.
        pa.ArrowException: if it is no such table.
    """
    names = list(columns or schema.names)
    wanted = pa.schema([schema.field(name) for name in names])
    with pq.ParquetFile(pa.BufferReader(filesystem.cat_file(path)), pre_buffer=False) as file:
        there = [name for name in names if name in file.schema_arrow.names]
        table = file.read(there, use_threads=False)
    return pa.concat_tables([wanted.empty_table(), table], promote_options="default").cast(wanted)


@atexit.register
def _wait_for_arrow() -> None:
    until = time.monotonic() + _LONGEST_S
    while _LENT and time.monotonic() < until:
        time.sleep(0.005)
