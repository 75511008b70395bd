"""What the scenes of a finished or running build took, for `tableverse estimate`."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from tableverse_factory.core.storage.files import StoragePath, list_names, list_sizes
from tableverse_factory.dataset.consolidated_tables import MERGED
from tableverse_factory.dataset.cost_estimate import BuildSample, StageTimes, Values
from tableverse_factory.dataset.shard_plan import Plan, read_plan
from tableverse_factory.dataset.shards import FOLDERS, SPARSE, committed_shards, shard_name, shard_path
from tableverse_factory.run_record import read_run
from workers.progress.scene_status import SceneStatus, make_scene_status, read_committed_scenes
from workers.state.checkpoint_store import CHECKPOINTS, CheckpointStore
from workers.state.journal import find_journals, read_journal, read_result
from workers.state.ledger import WORK, journal_path

_TABLES = tuple(folder for folder in FOLDERS if folder != "mjcf")
_UNKNOWN_POOL = "geometry"


@dataclass(slots=True)
class _Sizes:
    """Bytes per scene, by what holds them, of the shards that were measured."""

    tar: list[float] = field(default_factory=list)
    tables: list[float] = field(default_factory=list)
    records: list[float] = field(default_factory=list)


def collect_measurements(out: StoragePath, pool_of: Mapping[str, str]) -> BuildSample:
    """Reads what every scene that is accounted for took.

    Args:
        out: The dataset.
        pool_of: Of every stage, the pool that runs it.

    Raises:
        BuildError: if there is no build, or a table is damaged.
    """
    run, plan = read_run(out / "run.json"), read_plan(out / "plan.parquet")
    journals = find_journals(list_names(out / WORK))
    committed, kept = committed_shards(out), set(list_names(out / CHECKPOINTS))
    scenes: dict[str, SceneStatus] = {}
    sizes = _Sizes()
    for shard in sorted(journals | committed):
        found = read_committed_scenes(out, shard) if shard in committed else {}
        if found:
            _add_sizes(out, shard, found, kept, sizes)
        scenes |= _apply_journal(out, shard, found) if shard in journals else found
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
        input_tokens=_tokens([sum(cost.input_tokens for cost in scene.costs.values()) for scene in scenes.values()]),
        output_tokens=_tokens([sum(cost.output_tokens for cost in scene.costs.values()) for scene in scenes.values()]),
        notes=tuple(notes),
    )


def _tokens(counts: Sequence[int]) -> Values:
    return np.array(counts, float)


def _apply_journal(out: StoragePath, shard: int, committed: Mapping[str, SceneStatus]) -> dict[str, SceneStatus]:
    """The shard's scenes as they count now; a journal that goes meanwhile leaves what was seen."""
    place = journal_path(out, shard)
    contents = read_journal(place)
    scenes = {scene_id: scene for scene_id, scene in committed.items() if scene_id not in contents.reopened}
    try:
        for scene_id, entry in contents.results.items():
            scenes[scene_id] = make_scene_status(read_result(place, entry))
    except FileNotFoundError:
        return {**scenes, **read_committed_scenes(out, shard)}
    return scenes


def _add_sizes(out: StoragePath, shard: int, scenes: Mapping[str, SceneStatus], kept: set[str], sizes: _Sizes) -> None:
    """Adds the bytes of a committed shard; its tables are shared out evenly."""
    sizes.tar += [float(scene.tar_bytes or 0) for scene in scenes.values()]
    tables = sum(_read_size(shard_path(out, table, shard)) for table in _TABLES)
    tables += sum(list_sizes(out / table).get(shard_name(table, shard), 0) for table in SPARSE)
    sizes.tables += [tables / len(scenes)] * len(scenes)
    folder = f"shard-{shard:05d}"
    if folder in kept:
        records: Counter[str] = Counter()
        for name, located in CheckpointStore(out / CHECKPOINTS).index(shard).items():
            records[name.partition("/")[2].rsplit(".", 2)[0]] += located.size
        sizes.records += [float(records[scene_id]) for scene_id in scenes]


def _read_size(place: StoragePath) -> int:
    size: int = place.stat().st_size
    return size


def _collect_stage_times(
    scenes: Mapping[str, SceneStatus], plan: Plan, pool_of: Mapping[str, str]
) -> tuple[tuple[StageTimes, ...], list[str]]:
    """Times by stage, over all scenes in one order; where a scene began with a kept record, the mean of the others."""
    kinds = dict(zip(plan.scene_ids, plan.kinds, strict=True))
    lines = {
        kind: _find_longest_chain(scene for scene_id, scene in scenes.items() if kinds[scene_id] == kind) for kind in set(plan.kinds)
    }
    names = dict.fromkeys(name for _, line in sorted(lines.items(), key=lambda item: -len(item[1])) for name in line)
    cpu = {name: np.zeros(len(scenes)) for name in names}
    wall = {name: np.zeros(len(scenes)) for name in names}
    for number, (scene_id, scene) in enumerate(scenes.items()):
        line = lines[kinds[scene_id]]
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
    """The stages of scenes of one kind, in order: those of the scene that ran through the most."""
    longest = max(scenes, key=lambda scene: len(scene.timings), default=None)
    return () if longest is None else tuple(stage for stage, _, _ in longest.timings)


def _fill_unknown(cpu_s: Values, wall_s: Values) -> int:
    """Puts means where a stage must have run and no time is known; returns where that was."""
    unknown = np.isnan(cpu_s)
    reached = ~unknown & (wall_s > 0)
    if unknown.any():
        for values in (cpu_s, wall_s):
            values[unknown] = values[reached].mean() if reached.any() else 0.0
    return int(unknown.sum())
