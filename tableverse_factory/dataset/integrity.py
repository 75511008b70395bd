"""Integrity of committed shards: missing files, and tars of another length than was written."""

import tarfile
from collections.abc import Collection, Iterable, Mapping
from functools import partial

import pyarrow as pa
import pyarrow.compute as pc

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import StoragePath, list_names, list_sizes
from tableverse_factory.dataset.committed_rows import map_parts, read_shard
from tableverse_factory.dataset.shards import FOLDERS, advise_repair, shard_name, shard_path


def check_files(out: StoragePath, committed: Iterable[int]) -> None:
    """Check that every file of the committed shards exists, with one listing per folder.

    Safe while a build runs: a shard that is rewritten leaves `scenes/` first, and its other files are replaced, not
    removed. So list the committed shards before.
    """
    shards = sorted(committed)
    for folder in (name for name in FOLDERS if name != "scenes"):
        names = set(list_names(out / folder)) if shards else set()
        for shard in shards:
            if shard_name(folder, shard) not in names:
                path = shard_path(out, folder, shard)
                raise BuildError(f"{path} is damaged (it is missing): {advise_repair(path)}")


def check_tars(out: StoragePath, committed: Iterable[int]) -> None:
    """Compare the length of every tar with the offsets of its scenes; needs a dataset that no build is writing.

    A table of trajectories must exist if scenes have some.

    Raises:
        FileNotFoundError: if a shard is being rewritten just now.
    """
    shards = sorted(committed)
    trajectory_files = frozenset(list_names(out / "trajectories") if shards else ())
    check = partial(_check_tar, out, list_sizes(out / "mjcf") if shards else {}, trajectory_files)
    for _ in map_parts(lambda part: list(map(check, part)), out, shards):
        pass


def tar_length(end: int) -> int:
    """Compute the length of a tar whose last scene ends at `end`: two empty blocks, then up to a record [bytes]."""
    return -(-(end + 2 * tarfile.BLOCKSIZE) // tarfile.RECORDSIZE) * tarfile.RECORDSIZE


def _check_tar(out: StoragePath, sizes: Mapping[str, int], trajectory_files: Collection[str], shard: int) -> None:
    path = shard_path(out, "mjcf", shard)
    table = read_shard(out, "scenes", shard, ["tar_offset", "tar_size", "n_trajectories"])
    end: pa.Scalar = pc.max(pc.add(table["tar_offset"], table["tar_size"]))
    written, found = tar_length(end.as_py() or 0), sizes.get(path.name, 0)
    if found != written:
        raise BuildError(f"{path} is damaged ({found} bytes, not {written}): {advise_repair(path)}")
    rows = shard_path(out, "trajectories", shard)
    if pc.sum(table["n_trajectories"]).as_py() and rows.name not in trajectory_files:
        raise BuildError(f"{rows} is damaged (it is missing): {advise_repair(rows)}")
