"""What a committed shard has lost since: files that are gone, and a tar that is not as long as it was written."""

import tarfile
from collections.abc import Collection, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pyarrow as pa
import pyarrow.compute as pc
from upath import UPath

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import StoragePath, list_names, list_sizes
from tableverse_factory.dataset.committed_rows import read_shard
from tableverse_factory.dataset.shards import FOLDERS, advise_repair, shard_path

_AT_ONCE = 8


def check_files(out: StoragePath, committed: Iterable[int]) -> None:
    """Looks whether every file of the committed shards is there, with one look at each folder.

    Safe while a build runs: a shard that is written anew leaves `scenes/` first, and its other files are replaced, not
    removed. So list the committed shards before.

    Raises:
        BuildError: naming the first file that is gone, and what to do.
    """
    shards = sorted(committed)
    for folder in (name for name in FOLDERS if name != "scenes"):
        there = set(list_names(out / folder)) if shards else set()
        for path in (shard_path(out, folder, shard) for shard in shards):
            if path.name not in there:
                raise BuildError(f"{path} is damaged (it is missing): {advise_repair(path)}")


def check_tars(out: StoragePath, committed: Iterable[int]) -> None:
    """Compares the length of every tar with what its scenes say; it is sure where no build writes meanwhile.

    A table of trajectories must be there where scenes have some. Three columns of every shard are read; in a store
    several at once, because each means to wait for answers.

    Raises:
        FileNotFoundError: if a shard is being written again just now.
        BuildError: naming the first tar that is shorter or longer than it was written, or the table that is gone, and
            what to do.
    """
    shards = sorted(committed)
    motions = frozenset(list_names(out / "trajectories") if shards else ())
    check = partial(_check_tar, out, list_sizes(out / "mjcf") if shards else {}, motions)
    if not isinstance(out, UPath):
        for shard in shards:
            check(shard)
        return
    with ThreadPoolExecutor(_AT_ONCE) as threads:
        list(threads.map(check, shards))


def tar_length(end: int) -> int:
    """Length of a tar whose last scene ends at `end` [bytes]: two empty blocks, then up to a whole record."""
    return -(-(end + 2 * tarfile.BLOCKSIZE) // tarfile.RECORDSIZE) * tarfile.RECORDSIZE


def _check_tar(out: StoragePath, sizes: Mapping[str, int], motions: Collection[str], shard: int) -> None:
    path = shard_path(out, "mjcf", shard)
    table = read_shard(out, "scenes", shard, ["tar_offset", "tar_size", "n_trajectories"])
    end: pa.Scalar = pc.max(pc.add(table["tar_offset"], table["tar_size"]))
    written, found = tar_length(end.as_py() or 0), sizes.get(path.name, 0)
    if found != written:
        raise BuildError(f"{path} is damaged ({found} bytes, not {written}): {advise_repair(path)}")
    rows = shard_path(out, "trajectories", shard)
    if pc.sum(table["n_trajectories"]).as_py() and rows.name not in motions:
        raise BuildError(f"{rows} is damaged (it is missing): {advise_repair(rows)}")
