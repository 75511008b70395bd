"""Provisional rows: scenes that ended in shards which are not committed yet, so that a dataset is read while it grows.

They come from the journals and parts of a build on the disk or in an object store, and go when their shard is
committed, which has the same rows.
"""

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import pyarrow as pa

from schemas.tables import TABLES
from schemas.work import ScenePart, SceneResult
from tableverse_factory.core.framing import FrameError
from tableverse_factory.core.storage.files import StoragePath, list_names, list_sizes
from tableverse_factory.core.storage.parquet import build_table
from tableverse_factory.dataset.journals import WORK, find_journals, journal_path, read_results
from tableverse_factory.dataset.parts import SceneRows, files_offset, parts_folder, read_part_rows
from tableverse_factory.dataset.scene_rows import complete_rows
from tableverse_factory.dataset.shards import committed_shards

NO_OFFSET = -1  # tar_offset of a scene that no tar holds yet
_N_THREADS = 8


@dataclass(frozen=True, slots=True)
class ProvisionalScenes:
    """Scenes that ended in open shards.

    Attributes:
        tables: Their rows, by table. `tar_offset` is -1 where a scene has files.
        parts: Shard and place of each scene with files, by id.
        shards: The committed shards, listed after the rows were read: none of these holds a provisional scene.
    """

    tables: Mapping[str, pa.Table]
    parts: Mapping[str, tuple[int, ScenePart]]
    shards: tuple[int, ...]


def read_provisional(out: StoragePath) -> ProvisionalScenes:
    """Read the scenes that ended in open shards; safe while they are being committed."""
    results = _read_open_results(out)
    with ThreadPoolExecutor(_N_THREADS) as threads:
        rows = list(threads.map(lambda its: _read_rows(out, *its), results))
    committed = committed_shards(out)
    found = [
        (shard, result, its)
        for (shard, result), its in zip(results, rows, strict=True)
        if its is not None and shard not in committed
    ]
    return ProvisionalScenes(
        tables={
            name: build_table(_chain_rows([its for _, _, its in found], name), schema)
            for name, schema in TABLES.items()
        },
        parts={result.scene_id: (shard, result.part) for shard, result, _ in found if result.part is not None},
        shards=tuple(sorted(committed)),
    )


def find_cut_scenes(out: StoragePath) -> list[str]:
    """Find scenes of open shards whose files are gone or cut short, as after a loss of power; nothing else is read."""
    results = _read_open_results(out)
    sizes = {shard: list_sizes(parts_folder(out, shard)) for shard in dict(results)}
    committed = committed_shards(out)  # listed last: the parts of these are gone by right
    parts = [(shard, result.scene_id, result.part) for shard, result in results if shard not in committed]
    return [
        scene_id
        for shard, scene_id, part in parts
        if part is not None and sizes[shard].get(part.file, 0) < files_offset(part) + part.files_size
    ]


def _read_open_results(out: StoragePath) -> list[tuple[int, SceneResult]]:
    """Read the results of scenes in open shards, each with its shard."""
    open_shards = sorted(find_journals(list_names(out / WORK)) - committed_shards(out))
    return [(shard, result) for shard in open_shards for result in read_results(journal_path(out, shard)).values()]


def _read_rows(out: StoragePath, shard: int, result: SceneResult) -> SceneRows | None:
    """Read all rows of a scene; None if its part does not read, as its shard was committed, or it is computed again."""
    if result.part is None:
        return complete_rows(result, None, shard, None)
    try:
        own = read_part_rows(out, shard, result.part)
    except (FileNotFoundError, FrameError):
        return None
    return complete_rows(result, own, shard, (NO_OFFSET, result.part.files_size))


def _chain_rows(scenes: list[SceneRows], table: str) -> Iterator[dict[str, Any]]:
    return (row for rows in scenes for row in rows[table])
