"""Reader of the tables of committed shards, on the disk or in a store, also while a build rewrites some of them.

Consumers open a finished dataset with `open_dataset`, which reads HTTP and the Hub too; this one serves what builds,
summarizes and checks it.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import pyarrow as pa
from upath import UPath

from schemas.tables import STORED_TABLES
from tableverse_factory.core.errors import BuildError, StoreError
from tableverse_factory.core.storage.files import StoragePath, list_names
from tableverse_factory.core.storage.parquet import open_parquet, read_table
from tableverse_factory.dataset.shards import SPARSE, advise_repair, shard_name, shard_path

T = TypeVar("T")

_N_THREADS = 8
_PART = 64


def read_shard(out: StoragePath, table: str, shard: int, columns: Sequence[str] | None = None) -> pa.Table:
    """Read a table of one shard.

    Raises:
        FileNotFoundError: if the shard is being rewritten, or has no rows in this table.
    """
    path = shard_path(out, table, shard)
    with _name_damage(path):
        return read_table(path, STORED_TABLES[table], columns)


@contextmanager
def _name_damage(path: StoragePath) -> Iterator[None]:
    try:
        yield
    except (FileNotFoundError, StoreError):
        raise
    except (OSError, pa.ArrowException) as error:
        raise BuildError(f"{path} is damaged ({' '.join(str(error).split())[:200]}): {advise_repair(path)}") from error


def read_columns(out: StoragePath, table: str, shards: Iterable[int], columns: Sequence[str]) -> pa.Table:
    """Read columns of a table of these shards, in their order, without those that are being rewritten just now."""
    present = set(list_names(out / table)) if table in SPARSE else None
    numbers = [shard for shard in shards if present is None or shard_name(table, shard) in present]
    nothing = STORED_TABLES[table].empty_table().select(list(columns))

    def read(part: Sequence[int]) -> pa.Table:
        found = (_read_if_there(out, table, shard, columns) for shard in part)
        return pa.concat_tables([nothing, *(rows for rows in found if rows is not None)]).combine_chunks()

    return pa.concat_tables([nothing, *map_parts(read, out, numbers)])


def _read_if_there(out: StoragePath, table: str, shard: int, columns: Sequence[str]) -> pa.Table | None:
    try:
        return read_shard(out, table, shard, columns)
    except FileNotFoundError:
        return None


def count_rows(out: StoragePath, table: str, shards: Iterable[int]) -> int:
    """Count the rows of a table of these shards, without those that are being rewritten just now."""
    return sum(map_parts(lambda part: sum(_count_if_there(out, table, shard) for shard in part), out, shards))


def _count_if_there(out: StoragePath, table: str, shard: int) -> int:
    path = shard_path(out, table, shard)
    try:
        with _name_damage(path), open_parquet(path) as file:
            return int(file.metadata.num_rows)
    except FileNotFoundError:
        return 0


def map_parts(work: Callable[[Sequence[int]], T], out: StoragePath, shards: Iterable[int]) -> Iterator[T]:
    """Apply `work` to parts of the shards, and iterate over the results in the order of the shards.

    On the disk a part has many shards; in a store it has one, and several are read at once, because reads mostly wait
    for answers.
    """
    numbers = list(shards)
    if isinstance(out, UPath):
        with ThreadPoolExecutor(_N_THREADS) as threads:
            yield from threads.map(lambda shard: work([shard]), numbers)
    else:
        yield from (work(numbers[start : start + _PART]) for start in range(0, len(numbers), _PART))
