"""Scan of thousands of shards by several processes.

Threads gain little here: the time goes into the interpreter and into a decompressor for each of many small columns.
A process is `python -m workers.progress.scan OUT FIRST STOP COLUMNS TIMING_COLUMNS`, which writes a line of JSON, then
tables as Arrow streams.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import IO

import pyarrow as pa

from tableverse_factory.core.storage.files import StoragePath
from workers.progress.shard_rows import ShardReader, ShardRows

_SHARDS_PER_PROCESS = 1000  # fewer take less time than the start of a process
_MAX_PROCESSES = 4


def scan_shards(out: StoragePath, columns: Sequence[str], timing_columns: Sequence[str], n_shards: int) -> ShardRows:
    """Read all shards of a plan, in their order; in processes if they are many and on a disk."""
    reader = ShardReader(out, columns, timing_columns)
    there = reader.list_shards(range(n_shards))
    n_processes = min(_MAX_PROCESSES, os.cpu_count() or 1, len(there) // _SHARDS_PER_PROCESS)
    if not isinstance(out, Path) or n_processes < 2:
        return reader.read(range(n_shards))
    bounds = [0, *(there[len(there) * part // n_processes] for part in range(1, n_processes)), n_shards]
    parts = [range(first, stop) for first, stop in pairwise(bounds)]
    with ExitStack() as stack:
        scans = [stack.enter_context(_start_scan(out, columns, timing_columns, part)) for part in parts]
        for scan in scans:
            stack.callback(scan.kill)
        found = [_receive_rows(scan) for scan in scans]
    # a part whose process failed is read again here, which raises its error
    return reader.join(rows or reader.read(part) for rows, part in zip(found, parts, strict=True))


def _start_scan(
    out: Path, columns: Sequence[str], timing_columns: Sequence[str], shards: range
) -> subprocess.Popen[bytes]:
    words = (str(out), str(shards.start), str(shards.stop), ",".join(columns), ",".join(timing_columns))
    command = (sys.executable, "-m", "workers.progress.scan", *words)
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)


def _receive_rows(scan: subprocess.Popen[bytes]) -> ShardRows | None:
    """Receive what a process read; None if it failed."""
    if scan.stdout is None or not (head := scan.stdout.readline()):
        return None
    told = json.loads(head)
    tables = [pa.ipc.open_stream(scan.stdout).read_all() for _ in range(told["tables"])]
    return ShardRows(tables[0], tables[1], tables[-1] if told["tables"] > 2 else tables[0], told["whole"])


def _send_rows(rows: ShardRows, stream: IO[bytes]) -> None:
    tables = [rows.scenes, rows.timings, *([] if rows.stored is rows.scenes else [rows.stored])]
    stream.write(json.dumps({"tables": len(tables), "whole": rows.whole}).encode() + b"\n")
    for table in tables:
        with pa.ipc.new_stream(stream, table.schema) as writer:
            writer.write_table(table)


def main() -> None:
    """Read a range of shards and write its rows to stdout."""
    out, first, stop, *columns = sys.argv[1:]
    names, timing_names = (tuple(filter(None, text.split(","))) for text in columns)
    rows = ShardReader(Path(out), names, timing_names).read(range(int(first), int(stop)))
    _send_rows(rows, sys.stdout.buffer)


if __name__ == "__main__":
    main()
