"""Timings and sizes of the scenes of a finished or running build, for `tableverse estimate`."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from tableverse_factory.core.storage.files import StoragePath, list_names, list_sizes
from tableverse_factory.dataset.columns import count_groups
from tableverse_factory.dataset.consolidated_tables import MERGED
from tableverse_factory.dataset.cost_estimate import BuildSample, StageTimes, Values
from tableverse_factory.dataset.model_costs import MODEL_ROLE_BY_STAGE
from tableverse_factory.dataset.shard_plan import Plan, read_plan
from tableverse_factory.dataset.shards import FOLDERS, SPARSE, shard_name, shard_stem
from tableverse_factory.run_record import read_run
from workers.progress.build_state import BuildState, read_build_state
from workers.state.checkpoint_store import CHECKPOINTS, CheckpointStore

_TABLES = tuple(folder for folder in FOLDERS if folder != "mjcf")
_UNKNOWN_POOL = "geometry"


@dataclass(slots=True)
class _Sizes:
    """Sizes per scene of the measured shards [bytes]."""

    tar: list[float] = field(default_factory=list)
    tables: list[float] = field(default_factory=list)
    records: list[float] = field(default_factory=list)


def collect_measurements(out: StoragePath, pool_of: Mapping[str, str]) -> BuildSample:
    """Collect the timings, sizes and tokens of every scene that is accounted for; `pool_of` every stage."""
    run, plan, state = read_run(out / "run.json"), read_plan(out / "plan.parquet"), read_build_state(out)
    sizes = _measure_sizes(out, state)
    if sizes.tables and MERGED in list_names(out):
        merged = sum(list_sizes(out / MERGED).values())
        sizes.tables = [size + merged / len(sizes.tables) for size in sizes.tables]
    stages, notes = _collect_stage_times(state.scenes, state.timings, plan, pool_of)
    names = {stage.name for stage in stages}
    notes += [f"{name}: no timings here, so it is not counted" for name in run.get("stages", {}) if name not in names]
    storage = {"scenes": sizes.tar, "tables": sizes.tables, "stage records": sizes.records}
    return BuildSample(
        stages=stages,
        storage={name: np.array(values) for name, values in storage.items() if values},
        input_tokens=_sum_tokens(state.scenes, "input_tokens"),
        output_tokens=_sum_tokens(state.scenes, "output_tokens"),
        notes=tuple(notes),
    )


def _measure_sizes(out: StoragePath, state: BuildState) -> _Sizes:
    """Measure the published shards; their tables are shared out evenly among their scenes."""
    sizes, with_checkpoints = _Sizes(), set(list_names(out / CHECKPOINTS))
    on_disk = {table: list_sizes(out / table) for table in (*_TABLES, *SPARSE)}
    held = state.scenes.filter(pc.is_valid(state.scenes["tar_size"])).select(["scene_id", "shard", "tar_size"])
    sizes.tar = held["tar_size"].cast(pa.float64()).to_pylist()
    start = 0
    for (shard,), n_scenes in count_groups(held, ["shard"]).items():  # in their order
        tables = sum(on_disk[table].get(shard_name(table, shard), 0) for table in on_disk)
        sizes.tables += [tables / n_scenes] * n_scenes
        if shard_stem(shard) in with_checkpoints:
            checkpoints: Counter[str] = Counter()
            for name, checkpoint in CheckpointStore(out / CHECKPOINTS).index(shard).items():
                checkpoints[name.partition("/")[2].rsplit(".", 2)[0]] += checkpoint.size
            ids = held["scene_id"].slice(start, n_scenes).to_pylist()
            sizes.records += [float(checkpoints[scene_id]) for scene_id in ids]
        start += n_scenes
    return sizes


def _sum_tokens(scenes: pa.Table, figure: str) -> Values:
    columns = [scenes[f"{role}_{figure}"].fill_null(0).to_numpy() for role in MODEL_ROLE_BY_STAGE.values()]
    return np.sum(columns, axis=0, dtype=float)


def _collect_stage_times(
    scenes: pa.Table, timings: pa.Table, plan: Plan, pool_of: Mapping[str, str]
) -> tuple[tuple[StageTimes, ...], list[str]]:
    """Collect times by stage, over all scenes in one order; stages that a checkpoint replaced get the others' mean."""
    kinds = pc.take(plan.kinds.values, pc.index_in(scenes["scene_id"], plan.scene_ids.values))
    owners = pc.index_in(timings["scene_id"], scenes["scene_id"]).to_numpy()
    ran = np.bincount(owners, minlength=scenes.num_rows)
    chains = {}
    for kind in kinds.unique().to_pylist():
        of_kind = pc.equal(kinds, kind).to_numpy()
        longest = int(np.argmax(np.where(of_kind, ran, -1)))
        line = timings["stage"].filter(pa.array(owners == longest)).to_pylist()
        chains[kind] = line, of_kind
    lines = sorted((line for line, _ in chains.values()), key=lambda line: -len(line))
    names = dict.fromkeys(name for line in lines for name in line)
    times = {}
    for name in names:
        unknown = np.zeros(scenes.num_rows, bool)
        for line, of_kind in chains.values():
            later = line[line.index(name) + 1 :] if name in line else []
            unknown |= of_kind & pc.is_in(scenes["stage"], pa.array(later, pa.string())).to_numpy()
        own = pc.equal(timings["stage"], name).to_numpy()
        times[name] = [np.where(unknown, np.nan, 0.0) for _ in range(2)]
        for values, column in zip(times[name], ("cpu_s", "wall_s"), strict=True):
            values[owners[own]] = timings[column].to_numpy()[own]
    notes = []
    for name, (cpu_s, wall_s) in times.items():
        if missing := _fill_unknown(cpu_s, wall_s):
            notes.append(f"{name}: {missing} scenes began with what was kept of it and count with the others' mean")
        if name not in pool_of:
            notes.append(f"{name}: no stage of this version; counted as one of pool {_UNKNOWN_POOL}")
    return tuple(StageTimes(name, pool_of.get(name, _UNKNOWN_POOL), *both) for name, both in times.items()), notes


def _fill_unknown(cpu_s: Values, wall_s: Values) -> int:
    """Replace unknown times of stages that must have run by means; returns the number of unknown times."""
    unknown = np.isnan(cpu_s)
    reached = ~unknown & (wall_s > 0)
    if unknown.any():
        for values in (cpu_s, wall_s):
            values[unknown] = values[reached].mean() if reached.any() else 0.0
    return int(unknown.sum())
