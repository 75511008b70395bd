"""What a dataset holds, counted: the figures behind the overview (paper, figure 2).

Tables are read in batches and only counted there, by Arrow and NumPy: memory grows with the number of different
labels, never with the number of objects.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds

from tableverse_factory.dataset.dataset import Dataset

FORMAT = "tableverse-statistics-1"
MAX_LABEL_CHARS = 200
TOP = 100
"""So many names are told of each ranking; the rest is one number."""

MASS_EDGES_KG = tuple(float(f"{10 ** (-3 + k / 6):.6g}") for k in range(28))
SIZE_EDGES_M = tuple(float(f"{10 ** (-2.5 + k / 8):.6g}") for k in range(23))
_TAIL_POINTS = 200
_MERGE_ROWS = 500_000


@dataclass(frozen=True, slots=True)
class Ranking:
    """How often each name occurs.

    Attributes:
        total: Of all names.
        names: How many different ones there are.
        top: The most frequent ones with their counts; equal counts in alphabetical order.
    """

    total: int
    names: int
    top: tuple[tuple[str, int], ...]


@dataclass(frozen=True, slots=True)
class Histogram:
    """Counts between edges; what lies beyond is counted apart, and so is what is missing.

    Attributes:
        edges: One more than counts; a value on an edge belongs to the bin above it.
    """

    edges: tuple[float, ...]
    counts: tuple[int, ...]
    below: int
    above: int
    missing: int


@dataclass(frozen=True, slots=True)
class OverviewLoss:
    """Scenes lost at one stage for one reason."""

    stage: str
    status: str
    reason: str
    count: int


@dataclass(frozen=True, slots=True)
class MotionLoss:
    """Tasks whose trajectory failed in one phase for one reason."""

    phase: str
    reason: str
    count: int


@dataclass(frozen=True, slots=True)
class Statistics:
    """All figures of the overview.

    Attributes:
        scenes: Counts: `entered`, `done`, `dropped`, `failed`, `usable`.
        objects: Counts: `total`, `contained`, `hinged`, `graspable`.
        kinds: Done scenes by what they were made from.
        sources: Done scenes by source.
        labels: Objects by name, lower case.
        long_tail: Rank and count of names, by falling count, at most 200 of them evenly spread over the orders of
            magnitude.
        objects_per_scene: Of done scenes.
        quality_scores: Of done scenes.
        masses_kg: Of objects.
        sizes_m: Longest side of objects.
        relations: Accepted tasks by relation.
        tasks: Counts: `accepted`, `refused`.
        trajectories: Counts: `tried`, `succeeded`; both 0 where none were asked for.
        trajectory_losses: Tasks that were tried and failed, by phase (empty before any motion) and reason, largest
            first.
        losses: Largest first.
    """

    scenes: Mapping[str, int]
    objects: Mapping[str, int]
    kinds: Ranking
    sources: Ranking
    labels: Ranking
    long_tail: tuple[tuple[int, int], ...]
    objects_per_scene: Histogram
    quality_scores: Histogram
    masses_kg: Histogram
    sizes_m: Histogram
    relations: Ranking
    tasks: Mapping[str, int]
    trajectories: Mapping[str, int]
    trajectory_losses: tuple[MotionLoss, ...]
    losses: tuple[OverviewLoss, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain values, for `json.dumps`."""
        return {"format": FORMAT, **asdict(self)}


def gather(dataset: Dataset) -> Statistics:
    """Counts all committed rows.

    Raises:
        InputError: if a committed shard lacks a table.
    """
    outcomes = _outcomes(dataset.scenes)
    done = pc.field("status") == "done"
    labels = _counted(_labels(_batches(dataset.objects, ("relabel_name", "label"))))
    n_accepted = dataset.tasks.count_rows(filter=pc.field("accepted"))
    return Statistics(
        scenes={
            "entered": sum(loss.count for loss in outcomes),
            **{s: sum(o.count for o in outcomes if o.status == s) for s in ("done", "dropped", "failed")},
            "usable": dataset.scenes.count_rows(filter=done & pc.field("usable")),
        },
        objects=_object_counts(dataset.objects),
        kinds=_ranking(_counted(_columns(dataset.scenes, "kind", done))),
        sources=_ranking(_counted(_columns(dataset.scenes, "source", done))),
        labels=_ranking(labels),
        long_tail=_long_tail(labels),
        objects_per_scene=_objects_per_scene(dataset.scenes, done),
        quality_scores=_histogram(_columns(dataset.scenes, "quality_score", done), np.arange(1, 12)),
        masses_kg=_histogram(_columns(dataset.objects, "mass_kg"), MASS_EDGES_KG),
        sizes_m=_histogram(_longest_sides(dataset.objects), SIZE_EDGES_M),
        relations=_ranking(_counted(_columns(dataset.tasks, "relation", pc.field("accepted")))),
        tasks={"accepted": n_accepted, "refused": dataset.tasks.count_rows() - n_accepted},
        trajectories={
            "tried": dataset.trajectories.count_rows(),
            "succeeded": dataset.trajectories.count_rows(filter=pc.field("success")),
        },
        trajectory_losses=_motion_losses(dataset.trajectories),
        losses=tuple(o for o in outcomes if o.status != "done"),
    )


def _batches(table: ds.Dataset, columns: Sequence[str], keep: pc.Expression | None = None) -> Iterator[pa.RecordBatch]:
    yield from table.scanner(columns=list(columns), filter=keep).to_batches()


def _columns(table: ds.Dataset, column: str, keep: pc.Expression | None = None) -> Iterator[pa.Array]:
    for batch in _batches(table, (column,), keep):
        yield batch.column(0)


def _outcomes(scenes: ds.Dataset) -> list[OverviewLoss]:
    """Scenes by status, stage and why; the done ones in one line."""
    keys = ["stage", "status", "why"]
    parts = []
    for batch in _batches(scenes, ("status", "stage", "reason", "error_kind")):
        status, stage, reason, kind = batch.columns
        done = pc.fill_null(pc.equal(status, "done"), False)
        why = pc.if_else(done, "", pc.fill_null(pc.coalesce(reason, kind), ""))
        rows = pa.table([pc.if_else(done, "", pc.fill_null(stage, "")), pc.fill_null(status, ""), why], names=keys)
        parts.append(rows.group_by(keys).aggregate([([], "count_all")]))
    if not parts:
        return []
    merged = pa.concat_tables(parts).group_by(keys).aggregate([("count_all", "sum")])
    losses = [
        OverviewLoss(row["stage"][:MAX_LABEL_CHARS], row["status"], row["why"][:MAX_LABEL_CHARS], row["count_all_sum"])
        for row in merged.to_pylist()
    ]
    return sorted(losses, key=lambda loss: (-loss.count, loss.stage, loss.status, loss.reason))


def _motion_losses(trajectories: ds.Dataset) -> tuple[MotionLoss, ...]:
    failed = trajectories.to_table(columns=["failed_phase", "reason"], filter=~pc.field("success"))
    counts = failed.group_by(["failed_phase", "reason"]).aggregate([([], "count_all")]).to_pylist()
    losses = (
        MotionLoss(
            (row["failed_phase"] or "")[:MAX_LABEL_CHARS], (row["reason"] or "")[:MAX_LABEL_CHARS], row["count_all"]
        )
        for row in counts
    )
    return tuple(sorted(losses, key=lambda loss: (-loss.count, loss.phase, loss.reason)))


def _labels(batches: Iterable[pa.RecordBatch]) -> Iterator[pa.Array]:
    """The judge's name of each object where it gave one, else the detector's, lower case."""
    for batch in batches:
        name = pc.if_else(
            pc.equal(pc.utf8_trim_whitespace(pc.fill_null(batch.column(0), "")), ""), *batch.columns[::-1]
        )
        yield pc.utf8_trim_whitespace(pc.utf8_lower(pc.fill_null(name, "")))


def _counted(columns: Iterable[pa.Array]) -> pa.Table:
    """`name` and `count`, a row per different value; what is missing is not counted."""
    schema = pa.schema([("name", pa.string()), ("count", pa.int64())])
    total, parts, rows = schema.empty_table(), [], 0
    for column in columns:
        counts = pc.value_counts(column)
        parts.append(pa.table([counts.field("values").cast(pa.string()), counts.field("counts")], schema=schema))
        rows += len(counts)
        if rows > _MERGE_ROWS:
            total, parts, rows = _merged(total, parts), [], 0
    total = _merged(total, parts)
    return total.filter(pc.and_(pc.is_valid(total["name"]), pc.not_equal(total["name"], "")))


def _merged(total: pa.Table, parts: Sequence[pa.Table]) -> pa.Table:
    merged = pa.concat_tables([total, *parts]).group_by("name").aggregate([("count", "sum")])
    return merged.rename_columns({"count_sum": "count"}).select(["name", "count"])


def _ranking(counts: pa.Table) -> Ranking:
    order = counts.sort_by([("count", "descending"), ("name", "ascending")]).slice(0, TOP).to_pylist()
    top = tuple((row["name"][:MAX_LABEL_CHARS], row["count"]) for row in order)
    return Ranking(_total(counts), counts.num_rows, top)


def _total(counts: pa.Table) -> int:
    return int(pc.sum(counts["count"]).as_py() or 0)


def _long_tail(counts: pa.Table) -> tuple[tuple[int, int], ...]:
    sizes = np.sort(counts["count"].to_numpy())[::-1]
    if not len(sizes):
        return ()
    ranks = np.unique(np.rint(np.geomspace(1, len(sizes), _TAIL_POINTS)).astype(np.int64))
    return tuple((int(rank), int(sizes[rank - 1])) for rank in ranks)


def _object_counts(objects: ds.Dataset) -> dict[str, int]:
    return {
        "total": objects.count_rows(),
        "contained": objects.count_rows(filter=pc.field("contained_in").is_valid()),
        "hinged": objects.count_rows(filter=pc.field("has_hinge")),
        "graspable": objects.count_rows(filter=pc.field("graspable")),
    }


def _objects_per_scene(scenes: ds.Dataset, done: pc.Expression) -> Histogram:
    """A bin per number up to 40, then by twos, fours and so on."""
    most = max((pc.max(c).as_py() or 0 for c in _columns(scenes, "n_objects", done)), default=0)
    width = 1
    while most >= 40 * width:
        width *= 2
    return _histogram(_columns(scenes, "n_objects", done), np.arange(0, most + 2 * width, width))


def _longest_sides(objects: ds.Dataset) -> Iterator[pa.Array]:
    for batch in _batches(objects, ("size_x_m", "size_y_m", "size_z_m")):
        yield pc.max_element_wise(*batch.columns, skip_nulls=False)


def _histogram(columns: Iterable[pa.Array], edges: Sequence[float] | np.ndarray) -> Histogram:
    bounds = np.asarray(edges, dtype=np.float64)
    counts, missing = np.zeros(len(bounds) + 1, dtype=np.int64), 0
    for column in columns:
        values = column.cast(pa.float64()).to_numpy(zero_copy_only=False)
        known = values[np.isfinite(values)]
        missing += len(values) - len(known)
        counts += np.bincount(np.searchsorted(bounds, known, side="right"), minlength=len(counts))
    inner = tuple(int(count) for count in counts[1:-1])
    return Histogram(tuple(float(e) for e in bounds), inner, int(counts[0]), int(counts[-1]), missing)
