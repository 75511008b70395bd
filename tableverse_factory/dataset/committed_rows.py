"""Reader of the tables of committed shards, on the disk or in a store, also while a build rewrites some of them.

Consumers open a finished dataset with `open_dataset`, which reads HTTP and the Hub too; this one serves what builds,
summarizes and checks it.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import pyarrow as pa

from schemas.tables import STORED_TABLES
from tableverse_factory.core.errors import BuildError, StoreError
from tableverse_factory.core.storage.files import StoragePath, list_names
from tableverse_factory.core.storage.parquet import read_table
from tableverse_factory.dataset.shards import SPARSE, advise_repair, shard_name, shard_path


def read_shard(out: StoragePath, table: str, shard: int, columns: Sequence[str] | None = None) -> pa.Table:
    """Read a table of one shard.

    Raises:
        FileNotFoundError: if the shard is being rewritten, or has no rows in this table.
    """
    path = shard_path(out, table, shard)
    try:
        return read_table(path, STORED_TABLES[table], columns)
    except (FileNotFoundError, StoreError):
        raise
    except (OSError, pa.ArrowException) as error:
        raise BuildError(f"{path} is damaged ({' '.join(str(error).split())[:200]}): {advise_repair(path)}") from error


def read_shards(
    out: StoragePath, table: str, shards: Iterable[int], columns: Sequence[str] | None = None
) -> Iterator[pa.Table]:
    """Read a table of these shards, in their order, without those that are being rewritten just now."""
    present = set(list_names(out / table)) if table in SPARSE else None
    for shard in shards:
        if present is None or shard_name(table, shard) in present:
            try:
                yield read_shard(out, table, shard, columns)
            except FileNotFoundError:
                continue


def read_rows(
    out: StoragePath, table: str, shards: Iterable[int], columns: Sequence[str] | None = None
) -> Iterator[dict[str, Any]]:
    """Read the rows of a table of these shards, as `read_shards` reads them."""
    for found in read_shards(out, table, shards, columns):
        yield from found.to_pylist()
