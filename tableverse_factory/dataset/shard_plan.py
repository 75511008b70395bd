"""Frozen plan of a build: the shard of each scene, decided once from the manifest's order before anything runs."""

import hashlib
import re
from array import array
from collections.abc import Collection, Iterable, Sequence
from typing import overload

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from schemas.manifest import ImageRow
from tableverse_factory.core.errors import BuildError, ConfigError, StoreError
from tableverse_factory.core.storage.files import StoragePath, make_missing_build_error, write_atomic
from tableverse_factory.core.storage.parquet import encode_parquet, read_table
from tableverse_factory.dataset.columns import HashIndex, TextColumn
from tableverse_factory.dataset.image_rows import as_image_rows

MAX_SHARDS = 1_000_000
PLAN = pa.schema([("scene_id", pa.string()), ("kind", pa.string()), ("shard", pa.int32())])


class Plan:
    """Scenes in the manifest's order, cut into shards of equal size; columns take some 60 bytes a scene."""

    __slots__ = ("_index", "_starts", "kinds", "scene_ids", "shards")

    def __init__(self, scene_ids: Iterable[str], kinds: Iterable[str], shards: Iterable[int]) -> None:
        """`shards` ascends."""
        self.scene_ids = TextColumn(scene_ids)  # unique; a scene's index in here is its rank everywhere
        self.kinds = TextColumn(kinds)
        self.shards = array("i", shards)  # of each scene
        numbers = np.frombuffer(self.shards, np.int32)
        self._starts = np.flatnonzero(np.diff(numbers, prepend=-1, append=-2))
        self._index: HashIndex | None = None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Plan) and (self.scene_ids, self.kinds, self.shards) == (
            other.scene_ids, other.kinds, other.shards,
        )  # fmt: skip

    __hash__ = None  # type: ignore[assignment]

    @property
    def n_shards(self) -> int:
        """Number of shards; 0 for an empty manifest."""
        return self.shards[-1] + 1 if self.shards else 0

    def members(self) -> Sequence[range]:
        """Return the ranks of the scenes of each shard."""
        return _Members(self._starts)

    def rank_of(self, scene_id: str) -> int:
        """Return the rank of a scene; KeyError if the plan does not have it. The first call makes an index."""
        if self._index is None:
            self._index = HashIndex(self.scene_ids)
        for rank in self._index.find_candidates(scene_id):
            if self.scene_ids[rank] == scene_id:
                return rank
        raise KeyError(scene_id)


class _Members(Sequence[range]):
    def __init__(self, starts: NDArray[np.int64]) -> None:
        self._starts = starts

    def __len__(self) -> int:
        return len(self._starts) - 1

    @overload
    def __getitem__(self, shard: int) -> range: ...
    @overload
    def __getitem__(self, shard: slice) -> list[range]: ...
    def __getitem__(self, shard: int | slice) -> range | list[range]:
        if isinstance(shard, slice):
            return [self[number] for number in range(len(self))[shard]]
        number = range(len(self))[shard]
        return range(int(self._starts[number]), int(self._starts[number + 1]))


def make_plan(rows: Sequence[ImageRow], shard_size: int) -> Plan:
    """Plan a manifest whose scene ids are unique: `shard_size` scenes a shard, in the manifest's order."""
    columns = as_image_rows(rows)
    shards = np.arange(len(rows), dtype=np.int32) // shard_size
    return Plan(columns.column("scene_id"), columns.column("kind"), array("i", shards.tobytes()))


def parse_shards(text: str) -> frozenset[int]:
    """Parse a list of shards such as `3-7,9`."""
    numbers: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,100})\s*(?:-\s*(\d{1,100})\s*)?", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if last < first:
            raise ConfigError(f"--shards {text[:80]!r}: give numbers and ranges from small to large, e.g. 3-7,9")
        if last >= MAX_SHARDS:
            raise ConfigError(f"--shards {text[:80]!r}: the largest number that is taken is {MAX_SHARDS - 1}")
        numbers.update(range(first, last + 1))
    return frozenset(numbers)


def check_shards(shards: Collection[int] | None, n_scenes: int, shard_size: int) -> None:
    """Check that the plan of a number of scenes has these shards; None stands for all."""
    n_shards = -(-n_scenes // shard_size)
    beyond = [shard for shard in shards or () if shard >= n_shards]
    if beyond:
        has = f"shards 0 to {n_shards - 1}" if n_shards else "no shards"
        raise ConfigError(f"--shards {min(beyond)}: the plan has {has}")


def digest_manifest(rows: Sequence[ImageRow]) -> str:
    """Hash the content of the rows, in order: the same for the same rows in another Parquet file.

    Columns that are newer than some finished datasets count only where they hold something.
    """
    digest = hashlib.sha256()
    for lines in as_image_rows(rows).encode_lines():
        digest.update(lines)
    return digest.hexdigest()


def write_plan(path: StoragePath, plan: Plan) -> None:
    """Write plan.parquet durably, with the same bytes for the same plan."""
    shards = pa.array(np.frombuffer(plan.shards, np.int32))
    columns = [plan.scene_ids.values, plan.kinds.values, shards]
    write_atomic(path, encode_parquet(pa.Table.from_arrays(columns, schema=PLAN).combine_chunks()))


def read_plan(path: StoragePath) -> Plan:
    """Read plan.parquet."""
    try:
        table = read_table(path, PLAN)
    except FileNotFoundError:
        raise make_missing_build_error(path) from None
    except StoreError:
        raise
    except (OSError, pa.ArrowException) as error:
        raise BuildError(
            f"{path} cannot be read ({' '.join(str(error).split())[:300]}): restore it from a copy, or begin in "
            "another OUT; scenes that are committed can still be read by query, extract and verify"
        ) from error
    shards = table["shard"].fill_null(-1).to_numpy()
    if table["scene_id"].null_count or table["kind"].null_count or np.any(np.diff(shards, prepend=0) < 0):
        raise BuildError(f"{path} is no plan (ids, kinds or ascending shards are missing): restore it from a copy")
    return Plan(TextColumn(table["scene_id"]), TextColumn(table["kind"]), array("i", shards.tobytes()))
