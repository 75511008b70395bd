"""Timings and sizes of the scenes of a finished or running build, for `tableverse estimate`."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from tableverse_factory.core.storage.files import StoragePath, list_names, list_sizes
from tableverse_factory.dataset.consolidated_tables import MERGED
from tableverse_factory.dataset.cost_estimate import BuildSample, StageTimes, Values
from tableverse_factory.dataset.shard_plan import Plan, read_plan
from tableverse_factory.dataset.shards import FOLDERS, SPARSE, shard_name, shard_path, shard_stem
from tableverse_factory.run_record import read_run
from workers.progress.build_state import BuildState, SceneStatus, read_build_state
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
    scenes = {scene.scene_id: scene for scene in state.scenes}
    sizes = _measure_sizes(out, state)
    if sizes.tables and MERGED in list_names(out):
        merged = sum(list_sizes(out / MERGED).values())
        sizes.tables = [size + merged / len(sizes.tables) for size in sizes.tables]
    stages, notes = _collect_stage_times(scenes, plan, pool_of)
    names = {stage.name for stage in stages}
    notes += [f"{name}: no timings here, so it is not counted" for name in run.get("stages", {}) if name not in names]
    storage = {"scenes": sizes.tar, "tables": sizes.tables, "stage records": sizes.records}
    return BuildSample(
        stages=stages,
        storage={name: np.array(values) for name, values in storage.items() if values},
        input_tokens=_sum_tokens(scenes.values(), "input_tokens"),
        output_tokens=_sum_tokens(scenes.values(), "output_tokens"),
        notes=tuple(notes),
    )


def _measure_sizes(out: StoragePath, state: BuildState) -> _Sizes:
    """Measure the published shards; their tables are shared out evenly among their scenes."""
    sizes, with_checkpoints = _Sizes(), set(list_names(out / CHECKPOINTS))
    by_shard: dict[int, list[SceneStatus]] = {shard: [] for shard in state.published}
    for scene in state.scenes:
        if scene.tar_bytes is not None:
            by_shard[scene.shard].append(scene)
    for shard, scenes in by_shard.items():
        if not scenes:
            continue
        sizes.tar += [float(scene.tar_bytes or 0) for scene in scenes]
        tables = sum(shard_path(out, table, shard).stat().st_size for table in _TABLES)
        tables += sum(list_sizes(out / table).get(shard_name(table, shard), 0) for table in SPARSE)
        sizes.tables += [tables / len(scenes)] * len(scenes)
        if shard_stem(shard) in with_checkpoints:
            checkpoints: Counter[str] = Counter()
            for name, checkpoint in CheckpointStore(out / CHECKPOINTS).index(shard).items():
                checkpoints[name.partition("/")[2].rsplit(".", 2)[0]] += checkpoint.size
            sizes.records += [float(checkpoints[scene.scene_id]) for scene in scenes]
    return sizes


def _sum_tokens(scenes: Iterable[SceneStatus], field_name: str) -> Values:
    return np.array([sum(getattr(cost, field_name) for cost in scene.costs.values()) for scene in scenes], float)


def _collect_stage_times(
    scenes: Mapping[str, SceneStatus], plan: Plan, pool_of: Mapping[str, str]
) -> tuple[tuple[StageTimes, ...], list[str]]:
    """Collect times by stage, over all scenes in one order; stages that a checkpoint replaced get the others' mean."""
    kinds = dict(zip(plan.scene_ids, plan.kinds, strict=True))
    chains = {
        kind: _find_longest_chain(scene for scene_id, scene in scenes.items() if kinds[scene_id] == kind)
        for kind in set(plan.kinds)
    }
    names = dict.fromkeys(name for _, line in sorted(chains.items(), key=lambda item: -len(item[1])) for name in line)
    cpu = {name: np.zeros(len(scenes)) for name in names}
    wall = {name: np.zeros(len(scenes)) for name in names}
    for number, (scene_id, scene) in enumerate(scenes.items()):
        line = chains[kinds[scene_id]]
        before = line[: line.index(scene.stage)] if scene.stage in line else ()
        for name in before:
            cpu[name][number] = wall[name][number] = np.nan
        for name, cpu_s, wall_s in scene.timings:
            cpu[name][number], wall[name][number] = cpu_s, wall_s
    notes = []
    for name in names:
        if missing := _fill_unknown(cpu[name], wall[name]):
            notes.append(f"{name}: {missing} scenes began with what was kept of it and count with the others' mean")
        if name not in pool_of:
            notes.append(f"{name}: no stage of this version; counted as one of pool {_UNKNOWN_POOL}")
    stages = tuple(StageTimes(name, pool_of.get(name, _UNKNOWN_POOL), cpu[name], wall[name]) for name in names)
    return stages, notes


def _find_longest_chain(scenes: Iterable[SceneStatus]) -> tuple[str, ...]:
    """Find the stages of scenes of one kind, in order: those of the scene that ran through the most."""
    longest = max(scenes, key=lambda scene: len(scene.timings), default=None)
    return () if longest is None else tuple(stage for stage, _, _ in longest.timings)


def _fill_unknown(cpu_s: Values, wall_s: Values) -> int:
    """Replace unknown times of stages that must have run by means; returns the number of unknown times."""
    unknown = np.isnan(cpu_s)
    reached = ~unknown & (wall_s > 0)
    if unknown.any():
        for values in (cpu_s, wall_s):
            values[unknown] = values[reached].mean() if reached.any() else 0.0
    return int(unknown.sum())
