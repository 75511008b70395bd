"""Frozen plan of a build: the shard of each scene, decided once from the manifest's order before anything runs."""

import hashlib
import itertools
import json
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import pyarrow as pa

from schemas.manifest import ImageRow
from tableverse_factory.core.errors import BuildError, ConfigError, StoreError
from tableverse_factory.core.storage.files import StoragePath, make_missing_build_error, write_atomic
from tableverse_factory.core.storage.parquet import encode_parquet, read_table

MAX_SHARDS = 1_000_000
PLAN = pa.schema([("scene_id", pa.string()), ("kind", pa.string()), ("shard", pa.int32())])


@dataclass(frozen=True, slots=True)
class Plan:
    """Scenes in the manifest's order, cut into shards of equal size."""

    scene_ids: tuple[str, ...]  # unique; a scene's index in here is its rank everywhere
    kinds: tuple[str, ...]
    shards: tuple[int, ...]  # of each scene, ascending from 0

    @property
    def n_shards(self) -> int:
        """Number of shards; 0 for an empty manifest."""
        return self.shards[-1] + 1 if self.shards else 0

    def members(self) -> tuple[range, ...]:
        """List the ranks of the scenes of each shard."""
        starts = [rank for rank, shard in enumerate(self.shards) if rank == 0 or self.shards[rank - 1] != shard]
        return tuple(itertools.starmap(range, itertools.pairwise([*starts, len(self.shards)])))


def make_plan(rows: Sequence[ImageRow], shard_size: int) -> Plan:
    """Plan a manifest whose scene ids are unique: `shard_size` scenes a shard, in the manifest's order."""
    return Plan(
        scene_ids=tuple(row.scene_id for row in rows),
        kinds=tuple(row.kind.value for row in rows),
        shards=tuple(rank // shard_size for rank in range(len(rows))),
    )


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

    `url` is newer than some finished datasets: a row without one is hashed as in these.
    """
    digest = hashlib.sha256()
    for row in rows:
        content = row.model_dump(mode="json", exclude=None if row.url else {"url"})
        digest.update(json.dumps(content, sort_keys=True).encode() + b"\n")
    return digest.hexdigest()


def write_plan(path: StoragePath, plan: Plan) -> None:
    """Write plan.parquet durably, with the same bytes for the same plan."""
    columns = {"scene_id": plan.scene_ids, "kind": plan.kinds, "shard": plan.shards}
    write_atomic(path, encode_parquet(pa.Table.from_pydict(columns, schema=PLAN)))


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
    columns = table.to_pydict()
    return Plan(tuple(columns["scene_id"]), tuple(columns["kind"]), tuple(columns["shard"]))
