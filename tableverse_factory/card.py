"""The dataset card, OUT/README.md: what is in the dataset, where scenes were lost, and under which licences."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from schemas.arrow import SCENES
from tableverse_factory.shards import shard_path
from tableverse_factory.text import printable

_COLUMNS = ("status", "stage", "reason", "error_kind", "licence", "quality_score", "usable", "displacement_median_m")
_MAX_ROWS = 40
_EXAMPLE = """\
import pyarrow.compute as pc
from tableverse_factory import open_dataset

dataset = open_dataset("…")
done = dataset.scenes.to_table(columns=["scene_id"], filter=pc.field("status") == "done")
model = dataset.scene(done["scene_id"][0].as_py()).model()  # a mujoco.MjModel"""


def dataset_card(out: Path, run: Mapping[str, Any], n_shards: int) -> str:
    """The card as Markdown, from the committed shards alone: the same for the same dataset."""
    scenes = _scenes(out, n_shards)
    rows = {table: _count_rows(out, table, n_shards) for table in ("objects", "tasks")}
    status = Counter(scenes["status"].to_pylist())
    parts = [
        "# Table-top scenes for MuJoCo",
        "Made by TableVerse Factory from pictures; every scene was settled, and certified on the exported XML.",
        _table(
            ("what", "count"),
            [
                ("scenes in the manifest", scenes.num_rows),
                ("done", status["done"]),
                ("dropped", status["dropped"]),
                ("failed", status["failed"]),
                ("objects", rows["objects"]),
                ("tasks", rows["tasks"]),
                ("shards", n_shards),
            ],
        ),
        "## Where scenes were lost",
        _funnel(scenes),
        "## Licences of the pictures",
        _licences(scenes),
        "## Reading it",
        f"```python\n{_EXAMPLE}\n```",
        "## How it was made",
        f"Seed {run['seed']}, configuration `{run['fingerprint'][:16]}`; `run.json` holds every value and version.",
    ]
    return "\n\n".join(parts) + "\n"


def _funnel(scenes: pa.Table) -> str:
    lost = scenes.filter(pc.not_equal(scenes["status"], "done"))
    if not lost.num_rows:
        return "None was."
    whys = [row["reason"] or row["error_kind"] for row in lost.select(["reason", "error_kind"]).to_pylist()]
    counts = Counter(zip(lost["status"].to_pylist(), lost["stage"].to_pylist(), whys, strict=True))
    return _table(("status", "stage", "why", "scenes"), [(*key, count) for key, count in _largest(counts)])


def _licences(scenes: pa.Table) -> str:
    done = scenes.filter(pc.equal(scenes["status"], "done"))
    counts = Counter(licence or "not stated" for licence in done["licence"].to_pylist())
    return _table(("licence", "done scenes"), [(key, count) for key, count in _largest(counts)])


def _largest(counts: Mapping[Any, int]) -> list[tuple[Any, int]]:
    return sorted(counts.items(), key=lambda item: (-item[1], str(item[0])))[:_MAX_ROWS]


def _scenes(out: Path, n_shards: int) -> pa.Table:
    if n_shards == 0:
        return SCENES.empty_table().select(list(_COLUMNS))
    paths = [str(shard_path(out, "scenes", number)) for number in range(n_shards)]
    return ds.dataset(paths, schema=SCENES, format="parquet").to_table(columns=list(_COLUMNS), use_threads=False)


def _count_rows(out: Path, table: str, n_shards: int) -> int:
    return sum(pq.read_metadata(shard_path(out, table, number)).num_rows for number in range(n_shards))


def _table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(_cell(cell) for cell in line) + " |" for line in lines)


def _cell(value: object) -> str:
    """Licences and reasons may be somebody else's text: one line, and no markup."""
    text = printable(str(value))
    return "".join("\\" + c if c in "|`*<>[]#\\" and text != "---" else c for c in text)
