"""What a scene costs, stage by stage: from its files to its place in a shard on disk, in this process alone."""

import io
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal

import mujoco
from threadpoolctl import threadpool_limits

from schemas.arrow import OBJECTS, SCENES, TASKS
from schemas.codec import decode, encode
from schemas.config import Config
from schemas.manifest import ImageRow
from schemas.outcome import Done
from schemas.scene import ExportedScene
from tableverse_factory.core.memoize import clear_caches
from tableverse_factory.core.seeding import rng_for
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.dataset.shards import TarShard, check_exported, parquet_bytes, rows_to_table
from tableverse_factory.models.services import Services
from tableverse_factory.pipeline import PIPELINES

RECORDS, COMMIT = "records", "commit"
"""What stages hand on as bytes and read again; the tar and the tables of a shard of one scene, written to disk."""

CacheState = Literal["cold", "warm"]


@dataclass(frozen=True, slots=True)
class SceneCost:
    """CPU time of one scene.

    Attributes:
        cache: Whether the cache of convex pieces was empty, or knew every mesh.
        ended: `done`, or why it went no further.
        objects: How many left the factory.
        cpu_s: Of each stage in order, then of `RECORDS` and `COMMIT` [s].
    """

    scene_id: str
    cache: CacheState
    ended: str
    objects: int
    cpu_s: dict[str, float]

    @property
    def total_s(self) -> float:
        """Of the whole scene [s]."""
        return sum(self.cpu_s.values())


def bench_stages(
    rows: Sequence[ImageRow], config: Config, on_scene: Callable[[], None] | None = None
) -> list[SceneCost]:
    """Each scene twice: first every one with an empty cache of its own, then every one with the cache it left.

    What a process remembers of the scenes before, here and in MuJoCo, is forgotten before each.

    Args:
        rows: Of a manifest.
        config: Of the run.
        on_scene: Called after each scene, twice in all.
    """
    costs = []
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        for cache in ("cold", "warm"):
            for index, row in enumerate(rows):
                costs.append(_cost(row, config, Path(folder) / f"{index}", cache))
                if on_scene is not None:
                    on_scene()
    return costs


def medians(costs: Sequence[SceneCost]) -> dict[str, float]:
    """Median CPU time of each stage and of the whole, over the scenes that went all the way [s]."""
    done = [cost for cost in costs if cost.ended == "done"]
    if not done:
        return {}
    stages = {name: median(cost.cpu_s.get(name, 0.0) for cost in done) for cost in done for name in cost.cpu_s}
    return {**stages, "together": median(cost.total_s for cost in done)}


def _cost(row: ImageRow, config: Config, folder: Path, cache: CacheState) -> SceneCost:
    clear_caches()
    mujoco.mj_clearCache(mujoco.mj_getCache())
    spent = _Clock()
    value: Any = None
    data = encode(row)
    for stage in PIPELINES[row.kind]:
        item = decode(data)
        spent.on(RECORDS)
        rng = rng_for(config.run.seed, row.scene_id, stage.name)
        outcome = stage.run(item, config, rng, Services(folder / "cache"))
        spent.on(stage.name)
        if not isinstance(outcome, Done):
            return SceneCost(row.scene_id, cache, str(outcome), 0, spent.cpu_s)
        value = outcome.value
        data = encode(value)
        spent.on(RECORDS)
    _commit(value, folder)
    spent.on(COMMIT)
    spent.cpu_s[RECORDS] = spent.cpu_s.pop(RECORDS)
    spent.cpu_s[COMMIT] = spent.cpu_s.pop(COMMIT)
    return SceneCost(row.scene_id, cache, "done", len(value.object_rows), spent.cpu_s)


class _Clock:
    """CPU time of this process by what it was spent on."""

    def __init__(self) -> None:
        self.cpu_s: dict[str, float] = {}
        self._last = time.process_time()

    def on(self, what: str) -> None:
        """Books the time since the last booking."""
        now = time.process_time()
        self.cpu_s[what] = self.cpu_s.get(what, 0.0) + now - self._last
        self._last = now


def _commit(scene: ExportedScene, folder: Path) -> None:
    check_exported(scene, scene.scene_id)
    for name, data in _shard(scene):
        write_atomic(folder / name, data)


def _shard(scene: ExportedScene) -> Iterator[tuple[str, bytes]]:
    tar = io.BytesIO()
    shard = TarShard(tar)
    shard.add(scene)
    shard.close()
    yield "mjcf.tar", tar.getvalue()
    for name, schema, rows in (
        ("objects", OBJECTS, scene.object_rows),
        ("tasks", TASKS, scene.task_rows),
        ("scenes", SCENES, (scene.scene_row,)),
    ):
        yield f"{name}.parquet", parquet_bytes(rows_to_table(rows, schema))
