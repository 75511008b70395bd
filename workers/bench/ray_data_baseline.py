"""A pipeline written with Ray Data, the baseline of `tableverse bench factory`.

`python -m workers.bench.ray_data_baseline MANIFEST OUT WORKERS PIPELINE BATCH`. Every stage is one `map_batches` on
bytes of the same codec, the last one writes a tar and the rows of objects and tasks per batch, and `write_parquet`
those of scenes. Ray Data fuses the chain into one task per block. There is no sandbox, deadline, row for a failed
scene, plan, resume or flush to the disk, and file names differ from run to run.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import ray
import ray.data

from schemas.codec import decode, encode
from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done
from schemas.tables import OBJECTS, SCENES, TASKS
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.shards import TarShard, check_exported, tar_sort_key
from tableverse_factory.models.services import Services
from tableverse_factory.stage import Stage
from workers.executors.ray_cluster import OBJECT_STORE_BYTES
from workers.sandbox.child import load_pipelines

_BLOCKS_PER_WORKER = 8
_ITEMS = pa.schema([("scene_id", pa.string()), ("item", pa.large_binary())])


def main() -> None:
    """Run the pipeline; write the monotonic time and the number of scenes after the start of Ray and at the end."""
    manifest, out, workers, pipeline, batch = sys.argv[1:]
    ray.init(
        num_cpus=int(workers),
        include_dashboard=False,
        object_store_memory=OBJECT_STORE_BYTES,
        logging_level="ERROR",
        log_to_driver=False,
    )
    ray.data.DataContext.get_current().enable_progress_bars = False
    _report(0)
    scenes = run(manifest, Path(out), int(workers), load_pipelines(pipeline)[SceneKind.CAPTURE], int(batch))
    _report(scenes)


def run(manifest: str, out: Path, workers: int, stages: Any, batch: int) -> int:
    """Run the pipeline on a manifest, `batch` scenes at a time; return the number of scenes."""
    for folder in ("mjcf", "objects", "tasks"):
        (out / folder).mkdir(parents=True)
    rows = ray.data.read_parquet(manifest, override_num_blocks=_BLOCKS_PER_WORKER * workers)
    batches: Any = {"batch_size": batch, "batch_format": "pyarrow"}
    items = rows.map_batches(_read_items, **batches)
    for stage in stages:
        items = items.map_batches(_make_step(stage), **batches)
    items.map_batches(_make_writer(out), **batches).write_parquet(str(out / "scenes"))
    return sum(pq.read_metadata(path).num_rows for path in (out / "scenes").glob("*.parquet"))


def _read_items(batch: Any) -> Any:
    rows = [ImageRow.model_validate({k: v for k, v in row.items() if v is not None}) for row in batch.to_pylist()]
    return _make_table([row.scene_id for row in rows], [encode(row) for row in rows])


def _make_step(stage: Stage) -> Callable[[Any], Any]:
    config, services = Config(), Services(cache_dir=Path())

    def run_stage(batch: Any) -> Any:
        ids, items = batch.column("scene_id").to_pylist(), []
        for scene_id, item in zip(ids, batch.column("item").to_pylist(), strict=True):
            answer = stage.run(decode(item), config, make_rng(config.run.seed, scene_id, stage.name), services)
            if not isinstance(answer, Done):
                raise TypeError(f"{scene_id}: {stage.name} answered {answer}: this comparison is of scenes that pass")
            items.append(encode(answer.value))
        return _make_table(ids, items)

    return run_stage


def _make_writer(out: Path) -> Callable[[Any], Any]:
    def write(batch: Any) -> Any:
        scenes = sorted(
            (decode(item) for item in batch.column("item").to_pylist()), key=lambda s: tar_sort_key(s.scene_id)
        )
        name, rows = scenes[0].scene_id, []
        with (out / "mjcf" / f"{name}.tar").open("wb") as file:
            tar = TarShard(file)
            for scene in scenes:
                check_exported(scene, scene.scene_id)
                offset, size = tar.add(scene)
                known = {"scene_id": scene.scene_id, "status": "done", "tar_offset": offset, "tar_size": size}
                rows.append({**scene.scene_row, **known})
            tar.close()
        objects = build_table((row for scene in scenes for row in scene.object_rows), OBJECTS)
        tasks = build_table((row for scene in scenes for row in scene.task_rows), TASKS)
        (out / "objects" / f"{name}.parquet").write_bytes(encode_parquet(objects))
        (out / "tasks" / f"{name}.parquet").write_bytes(encode_parquet(tasks))
        return build_table(rows, SCENES)

    return write


def _make_table(ids: list[str], items: list[bytes]) -> Any:
    return pa.Table.from_pydict({"scene_id": ids, "item": items}, schema=_ITEMS)


def _report(scenes: int) -> None:
    sys.stdout.write(f"{time.monotonic():.3f} {scenes}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
