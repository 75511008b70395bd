"""Query times of a dataset: filters, counts and scenes by id."""

import hashlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from schemas.tables import OBJECTS, SCENES, TASKS
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.dataset.query_parser import parse_filter
from tableverse_factory.dataset.shards import TarShard, shard_path, tar_sort_key
from tableverse_factory.evaluation.bench.noop_pipeline import make_minimal_scene

REPEATS = 9
OBJECTS_PER_SCENE = 10
_LABELS = 100
_COLUMNS = ["scene_id", "object_id", "label", "mass_kg", "size_x_m", "size_y_m", "size_z_m", "contained_in"]
_FIGURES = [name for name in OBJECTS.names if name.endswith(("_m", "_kg", "_m3")) or name in ("qw", "qx", "qy", "qz")]


@dataclass(frozen=True, slots=True)
class QueryTimes:
    """Medians of `REPEATS` repetitions after a warm-up [ms]."""

    what: str
    shards: int
    scenes: int
    objects: int
    found: int  # objects that pass the filter
    filter_ms: float  # filter of objects by label and confidence, in the columns that `query` shows
    count_ms: float  # count of usable scenes from a score on
    anew_ms: float  # the filter with the dataset opened for it
    scene_ms: float  # a scene by its id, compiled by MuJoCo; another scene each time
    first_ms: float  # the same with the dataset opened for it
    cpu_ms: float  # CPU time of the filter, all threads


def bench_query(out: Path, what: str) -> QueryTimes:
    """Measure query times of a dataset that has objects and scenes with files."""
    dataset = open_dataset(out)
    done = dataset.scenes.to_table(columns=["scene_id"], filter=parse_filter("tar_offset is not null", SCENES))
    label = dataset.objects.head(1, columns=["label"])["label"].to_pylist()
    if not done.num_rows or not label:
        raise InputError(f"{out}: no scene with objects and files")
    wanted = parse_filter(
        f"label = '{str(label[0]).replace(chr(39), 2 * chr(39))}' and label_confidence >= 0.9", OBJECTS
    )
    usable = parse_filter("usable and quality_score >= 9", SCENES)
    ids = done["scene_id"].take(np.linspace(0, done.num_rows - 1, REPEATS + 1).astype(int)).to_pylist()
    turn = iter([*ids, *ids])

    def find(opened: Dataset) -> int:
        return opened.objects.to_table(columns=_COLUMNS, filter=wanted).num_rows

    filter_ms, cpu_ms = _time_repeatedly(lambda: find(dataset))
    return QueryTimes(
        what=what,
        shards=len(dataset.shards),
        scenes=dataset.scenes.count_rows(),
        objects=dataset.objects.count_rows(),
        found=find(dataset),
        filter_ms=filter_ms,
        count_ms=_time_repeatedly(lambda: dataset.scenes.count_rows(filter=usable))[0],
        anew_ms=_time_repeatedly(lambda: find(open_dataset(out)))[0],
        scene_ms=_time_repeatedly(lambda: dataset.scene(next(turn)).model())[0],
        first_ms=_time_repeatedly(lambda: open_dataset(out).scene(next(turn)).model())[0],
        cpu_ms=cpu_ms,
    )


def write_query_dataset(out: Path, scenes: int, shard_size: int) -> int:
    """Write a dataset of minimal scenes with ten objects each and random figures."""
    rng = np.random.default_rng(0)
    for folder in ("mjcf", "scenes", "objects", "tasks"):
        (out / folder).mkdir(parents=True)
    (out / "run.json").write_text("{}")
    n_shards = -(-scenes // shard_size)
    for number in range(n_shards):
        ids = [_make_scene_id(i) for i in range(number * shard_size, min(scenes, (number + 1) * shard_size))]
        places: dict[str, tuple[int, int]] = {}
        with shard_path(out, "mjcf", number).open("wb") as file:
            tar = TarShard(file)
            for scene_id in sorted(ids, key=tar_sort_key):
                places[scene_id] = tar.add(make_minimal_scene(scene_id))
            tar.close()
        rows = [_make_scene_row(scene_id, number, places[scene_id], int(rng.integers(11))) for scene_id in ids]
        objects = [row for scene_id in ids for row in _make_object_rows(scene_id, rng)]
        tasks = [row for scene_id in ids for row in make_minimal_scene(scene_id).task_rows]
        for name, content, schema in (("objects", objects, OBJECTS), ("tasks", tasks, TASKS), ("scenes", rows, SCENES)):
            shard_path(out, name, number).write_bytes(encode_parquet(build_table(content, schema)))
    return n_shards


def _make_scene_id(number: int) -> str:
    return f"scene_{number:06d}-{hashlib.sha256(str(number).encode()).hexdigest()[:12]}"


def _make_scene_row(scene_id: str, shard: int, place: tuple[int, int], score: int) -> Mapping[str, Any]:
    known = {"scene_id": scene_id, "kind": "capture", "uri": f"/captures/{scene_id}", "status": "done"}
    row = {**known, "shard": shard, "tar_offset": place[0], "tar_size": place[1], "attempts": 1, "stage": "export"}
    return {**row, "n_objects": OBJECTS_PER_SCENE, "usable": score > 2, "quality_score": score}


def _make_object_rows(scene_id: str, rng: np.random.Generator) -> list[dict[str, Any]]:
    figures = rng.random((OBJECTS_PER_SCENE, len(_FIGURES) + 1)).tolist()
    labels = rng.integers(_LABELS, size=OBJECTS_PER_SCENE)
    return [
        {
            "scene_id": scene_id,
            "object_id": f"obj_{i:03d}",
            "label": f"thing {label}",
            "label_confidence": values[-1],
            **dict(zip(_FIGURES, values, strict=False)),
        }
        for i, (label, values) in enumerate(zip(labels, figures, strict=True))
    ]


def _time_repeatedly(work: Callable[[], object]) -> tuple[float, float]:
    """Return the medians of wall time and CPU time [ms]."""
    work()
    walls, cpus = [], []
    for _ in range(REPEATS):
        started, cpu = time.perf_counter(), time.process_time()
        work()
        walls.append(1e3 * (time.perf_counter() - started))
        cpus.append(1e3 * (time.process_time() - cpu))
    return median(walls), median(cpus)
