"""Statistics of a dataset for the overview (paper, figure 2).

Arrow and NumPy count tables batch by batch: memory grows with the number of different labels, not of objects.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds

from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.viz.funnel import SceneLoss

FORMAT = "tableverse-statistics-1"
MAX_LABEL_CHARS = 200
TOP = 100  # most names in a ranking

MASS_EDGES_KG = tuple(float(f"{10 ** (-3 + k / 6):.6g}") for k in range(28))
SIZE_EDGES_M = tuple(float(f"{10 ** (-2.5 + k / 8):.6g}") for k in range(23))
_TAIL_POINTS = 200
_MERGE_ROWS = 500_000


@dataclass(frozen=True, slots=True)
class Ranking:
    """Frequencies of names."""

    total: int
    names: int
    top: tuple[tuple[str, int], ...]  # most frequent names with counts; equal counts by alphabet


@dataclass(frozen=True, slots=True)
class Histogram:
    """Counts between edges; values beyond them and missing values are counted apart."""

    edges: tuple[float, ...]  # a value on an edge belongs to the bin above it
    counts: tuple[int, ...]
    below: int
    above: int
    missing: int


@dataclass(frozen=True, slots=True)
class MotionLoss:
    """Tasks whose trajectory failed in one phase for one reason."""

    phase: str
    reason: str
    count: int


@dataclass(frozen=True, slots=True)
class Statistics:
    """Figures of the overview."""

    scenes: Mapping[str, int]  # `entered`, `done`, `dropped`, `failed`, `usable`
    objects: Mapping[str, int]  # `total`, `contained`, `hinged`, `graspable`
    kinds: Ranking  # done scenes by kind of input
    sources: Ranking  # done scenes by source
    labels: Ranking  # objects by name, lower case
    long_tail: tuple[tuple[int, int], ...]  # at most 200 ranks of names and their counts, evenly spread on a log scale
    objects_per_scene: Histogram  # of done scenes
    quality_scores: Histogram  # of done scenes
    masses_kg: Histogram
    sizes_m: Histogram  # longest side of objects
    relations: Ranking  # accepted tasks by relation
    tasks: Mapping[str, int]  # `accepted`, `refused`
    trajectories: Mapping[str, int]  # `tried`, `succeeded`; both 0 without trajectories
    trajectory_losses: tuple[MotionLoss, ...]  # by phase (empty before any motion) and reason, largest first
    losses: tuple[SceneLoss, ...]  # lost scenes by stage, status and reason, largest first

    def to_json(self) -> dict[str, Any]:
        """Return plain values for `json.dumps`."""
        return {"format": FORMAT, **asdict(self)}


def compute_statistics(dataset: Dataset) -> Statistics:
    """Compute the statistics of all committed rows; raise an `InputError` if a committed shard lacks a table."""
    outcomes = _count_outcomes(dataset.scenes)
    done = pc.field("status") == "done"
    labels = _count_values(_choose_labels(_scan(dataset.objects, ("relabel_name", "label"))))
    n_accepted = dataset.tasks.count_rows(filter=pc.field("accepted"))
    return Statistics(
        scenes={
            "entered": sum(loss.count for loss in outcomes),
            **{s: sum(o.count for o in outcomes if o.status == s) for s in ("done", "dropped", "failed")},
            "usable": dataset.scenes.count_rows(filter=done & pc.field("usable")),
        },
        objects={
            "total": dataset.objects.count_rows(),
            "contained": dataset.objects.count_rows(filter=pc.field("contained_in").is_valid()),
            "hinged": dataset.objects.count_rows(filter=pc.field("has_hinge")),
            "graspable": dataset.objects.count_rows(filter=pc.field("graspable")),
        },
        kinds=_make_ranking(_count_values(_scan_column(dataset.scenes, "kind", done))),
        sources=_make_ranking(_count_values(_scan_column(dataset.scenes, "source", done))),
        labels=_make_ranking(labels),
        long_tail=_sample_tail(labels),
        objects_per_scene=_count_objects_per_scene(dataset.scenes, done),
        quality_scores=_make_histogram(_scan_column(dataset.scenes, "quality_score", done), np.arange(1, 12)),
        masses_kg=_make_histogram(_scan_column(dataset.objects, "mass_kg"), MASS_EDGES_KG),
        sizes_m=_make_histogram(_scan_longest_sides(dataset.objects), SIZE_EDGES_M),
        relations=_make_ranking(_count_values(_scan_column(dataset.tasks, "relation", pc.field("accepted")))),
        tasks={"accepted": n_accepted, "refused": dataset.tasks.count_rows() - n_accepted},
        trajectories={
            "tried": dataset.trajectories.count_rows(),
            "succeeded": dataset.trajectories.count_rows(filter=pc.field("success")),
        },
        trajectory_losses=_count_motion_losses(dataset.trajectories),
        losses=tuple(o for o in outcomes if o.status != "done"),
    )


def _scan(table: ds.Dataset, columns: Sequence[str], keep: pc.Expression | None = None) -> Iterator[pa.RecordBatch]:
    yield from table.scanner(columns=list(columns), filter=keep).to_batches()


def _scan_column(table: ds.Dataset, column: str, keep: pc.Expression | None = None) -> Iterator[pa.Array]:
    for batch in _scan(table, (column,), keep):
        yield batch.column(0)


def _count_outcomes(scenes: ds.Dataset) -> list[SceneLoss]:
    """Count scenes by status, stage and reason; finished ones in one entry."""
    keys = ["stage", "status", "why"]
    parts = []
    for batch in _scan(scenes, ("status", "stage", "reason", "error_kind")):
        status, stage, reason, kind = batch.columns
        done = pc.fill_null(pc.equal(status, "done"), False)
        why = pc.if_else(done, "", pc.fill_null(pc.coalesce(reason, kind), ""))
        rows = pa.table([pc.if_else(done, "", pc.fill_null(stage, "")), pc.fill_null(status, ""), why], names=keys)
        parts.append(rows.group_by(keys).aggregate([([], "count_all")]))
    if not parts:
        return []
    merged = pa.concat_tables(parts).group_by(keys).aggregate([("count_all", "sum")])
    losses = [
        SceneLoss(row["stage"][:MAX_LABEL_CHARS], row["status"], row["why"][:MAX_LABEL_CHARS], row["count_all_sum"])
        for row in merged.to_pylist()
    ]
    return sorted(losses, key=lambda loss: (-loss.count, loss.stage, loss.status, loss.reason))


def _count_motion_losses(trajectories: ds.Dataset) -> tuple[MotionLoss, ...]:
    failed = trajectories.to_table(columns=["failed_phase", "reason"], filter=~pc.field("success"))
    counts = failed.group_by(["failed_phase", "reason"]).aggregate([([], "count_all")]).to_pylist()
    most = MAX_LABEL_CHARS
    losses = [
        MotionLoss((row["failed_phase"] or "")[:most], (row["reason"] or "")[:most], row["count_all"]) for row in counts
    ]
    return tuple(sorted(losses, key=lambda loss: (-loss.count, loss.phase, loss.reason)))


def _choose_labels(batches: Iterable[pa.RecordBatch]) -> Iterator[pa.Array]:
    """Choose the judge's name of each object, else the detector's, in lower case."""
    for batch in batches:
        judged = pc.utf8_trim_whitespace(pc.fill_null(batch.column(0), ""))
        name = pc.if_else(pc.equal(judged, ""), *batch.columns[::-1])
        yield pc.utf8_trim_whitespace(pc.utf8_lower(pc.fill_null(name, "")))


def _count_values(columns: Iterable[pa.Array]) -> pa.Table:
    """Count values; return columns `name` and `count`, without missing values."""
    schema = pa.schema([("name", pa.string()), ("count", pa.int64())])
    total, parts, rows = schema.empty_table(), [], 0
    for column in columns:
        counts = pc.value_counts(column)
        parts.append(pa.table([counts.field("values").cast(pa.string()), counts.field("counts")], schema=schema))
        rows += len(counts)
        if rows > _MERGE_ROWS:
            total, parts, rows = _merge_counts(total, parts), [], 0
    total = _merge_counts(total, parts)
    return total.filter(pc.and_(pc.is_valid(total["name"]), pc.not_equal(total["name"], "")))


def _merge_counts(total: pa.Table, parts: Sequence[pa.Table]) -> pa.Table:
    merged = pa.concat_tables([total, *parts]).group_by("name").aggregate([("count", "sum")])
    return merged.rename_columns({"count_sum": "count"}).select(["name", "count"])


def _make_ranking(counts: pa.Table) -> Ranking:
    order = counts.sort_by([("count", "descending"), ("name", "ascending")]).slice(0, TOP).to_pylist()
    top = tuple((row["name"][:MAX_LABEL_CHARS], row["count"]) for row in order)
    return Ranking(int(pc.sum(counts["count"]).as_py() or 0), counts.num_rows, top)


def _sample_tail(counts: pa.Table) -> tuple[tuple[int, int], ...]:
    sizes = np.sort(counts["count"].to_numpy())[::-1]
    if not len(sizes):
        return ()
    ranks = np.unique(np.rint(np.geomspace(1, len(sizes), _TAIL_POINTS)).astype(np.int64))
    return tuple((int(rank), int(sizes[rank - 1])) for rank in ranks)


def _count_objects_per_scene(scenes: ds.Dataset, done: pc.Expression) -> Histogram:
    """Count objects per scene in bins of one up to 40 objects, else of two, four and so on."""
    most = max((pc.max(c).as_py() or 0 for c in _scan_column(scenes, "n_objects", done)), default=0)
    width = 1
    while most >= 40 * width:
        width *= 2
    return _make_histogram(_scan_column(scenes, "n_objects", done), np.arange(0, most + 2 * width, width))


def _scan_longest_sides(objects: ds.Dataset) -> Iterator[pa.Array]:
    for batch in _scan(objects, ("size_x_m", "size_y_m", "size_z_m")):
        yield pc.max_element_wise(*batch.columns, skip_nulls=False)


def _make_histogram(columns: Iterable[pa.Array], edges: Sequence[float] | np.ndarray) -> Histogram:
    bounds = np.asarray(edges, dtype=np.float64)
    counts, missing = np.zeros(len(bounds) + 1, dtype=np.int64), 0
    for column in columns:
        values = column.cast(pa.float64()).to_numpy(zero_copy_only=False)
        known = values[np.isfinite(values)]
        missing += len(values) - len(known)
        counts += np.bincount(np.searchsorted(bounds, known, side="right"), minlength=len(counts))
    inner = tuple(int(count) for count in counts[1:-1])
    return Histogram(tuple(float(e) for e in bounds), inner, int(counts[0]), int(counts[-1]), missing)
