"""CPU time of a scene by stage, from its input files to a shard on disk, in this process."""

import io
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, Literal

import mujoco
from threadpoolctl import threadpool_limits

from schemas.codec import decode, encode
from schemas.config import Config
from schemas.manifest import ImageRow
from schemas.outcome import Done
from schemas.scene import ExportedScene
from schemas.tables import OBJECTS, SCENES, TASKS
from tableverse_factory.core.memoize import clear_caches
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.shards import TarShard, check_exported
from tableverse_factory.evaluation.bench.measurement import Stopwatch
from tableverse_factory.models.services import Services
from tableverse_factory.pipeline import PIPELINES
from tableverse_factory.stage import import_stages

RECORDS, COMMIT = "records", "commit"  # coding of the records between the stages, and writing a shard of one scene

CacheState = Literal["cold", "warm"]


@dataclass(frozen=True, slots=True)
class SceneCost:
    """CPU time of one scene."""

    scene_id: str
    cache: CacheState  # whether the cache of convex pieces was empty, or held every mesh
    ended: str  # `done`, or the reason why it was dropped
    objects: int  # number of exported objects
    cpu_s: dict[str, float]  # of each stage in order, then of `RECORDS` and `COMMIT` [s]

    @property
    def total_s(self) -> float:
        """CPU time of the whole scene [s]."""
        return sum(self.cpu_s.values())


def bench_stages(
    rows: Sequence[ImageRow], config: Config, on_scene: Callable[[], object] = lambda: None
) -> list[SceneCost]:
    """Run every scene with an empty cache of its own, then every scene again with the cache that this left.

    The in-memory caches of this process and of MuJoCo are cleared before each scene; `on_scene` is called after each.
    """
    import_stages(PIPELINES[row.kind] for row in rows)
    costs = []
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        for cache in ("cold", "warm"):
            for index, row in enumerate(rows):
                costs.append(_measure_scene(row, config, Path(folder) / f"{index}", cache))
                on_scene()
    return costs


def compute_medians(costs: Sequence[SceneCost]) -> dict[str, float]:
    """Compute the median CPU time of each stage and of the whole, over the scenes that were exported [s]."""
    done = [cost for cost in costs if cost.ended == "done"]
    if not done:
        return {}
    stages = {name: median(cost.cpu_s.get(name, 0.0) for cost in done) for cost in done for name in cost.cpu_s}
    return {**stages, "together": median(cost.total_s for cost in done)}


def _measure_scene(row: ImageRow, config: Config, folder: Path, cache: CacheState) -> SceneCost:
    clear_caches()
    mujoco.mj_clearCache(mujoco.mj_getCache())
    watch = Stopwatch()
    value: Any = row
    with watch.measure(RECORDS):
        data = encode(value)
    for stage in PIPELINES[row.kind]:
        with watch.measure(RECORDS):
            item = decode(data)
        rng = make_rng(config.run.seed, row.scene_id, stage.name)
        with watch.measure(stage.name):
            outcome = stage.run(item, config, rng, Services(folder / "cache"))
        if not isinstance(outcome, Done):
            return SceneCost(row.scene_id, cache, str(outcome), 0, watch.cpu_s)
        value = outcome.value
        with watch.measure(RECORDS):
            data = encode(value)
    with watch.measure(COMMIT):
        _write_shard(value, folder)
    records_s, commit_s = watch.cpu_s.pop(RECORDS), watch.cpu_s.pop(COMMIT)
    cpu_s = {**watch.cpu_s, RECORDS: records_s, COMMIT: commit_s}
    return SceneCost(row.scene_id, cache, "done", len(value.object_rows), cpu_s)


def _write_shard(scene: ExportedScene, folder: Path) -> None:
    check_exported(scene, scene.scene_id)
    buffer = io.BytesIO()
    tar = TarShard(buffer)
    tar.add(scene)
    tar.close()
    write_atomic(folder / "mjcf.tar", buffer.getvalue())
    tables = (
        ("objects", OBJECTS, scene.object_rows),
        ("tasks", TASKS, scene.task_rows),
        ("scenes", SCENES, (scene.scene_row,)),
    )
    for name, schema, rows in tables:
        write_atomic(folder / f"{name}.parquet", encode_parquet(build_table(rows, schema)))
