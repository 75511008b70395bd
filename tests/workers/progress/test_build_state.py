"""Figures of a build's state: counted by column as one would count scene by scene."""

import math
import shutil
from collections import Counter
from dataclasses import replace
from statistics import mean, median

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.outcome import NO_COST, ModelCost
from schemas.tables import SCENES, TIMINGS
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.parquet import build_table
from tableverse_factory.dataset.judge_summary import JUDGEMENT_COLUMNS, summarize_judgements
from tableverse_factory.dataset.model_costs import COST_COLUMNS, sum_model_costs
from tableverse_factory.dataset.shards import shard_path
from tests.helpers.builds import Silent, build, request, scenes, write_manifest
from workers.plan.invalidate import reopen_scenes
from workers.progress import scan
from workers.progress.build_state import BuildState, read_build_state
from workers.progress.tally import Durations
from workers.run import run_build

STAGES = ("observe", "place", "export")
CODES = st.sampled_from([None, "", "too_dark", "timeout"])
SHARES = st.floats(0, 1)


def table_of(names):
    return pa.schema([SCENES.field(name) for name in names])


def rows_of(**columns):
    return st.lists(st.fixed_dictionaries(columns), max_size=30)


LOSSES = rows_of(
    status=st.sampled_from(["done", "dropped", "failed"]),
    stage=st.sampled_from(STAGES),
    reason=CODES,
    error_kind=CODES,
)
COSTS = rows_of(
    **{name: st.none() | (st.floats(0, 9) if name.endswith("usd") else st.integers(0, 99)) for name in COST_COLUMNS}
)
JUDGED = rows_of(
    status=st.sampled_from(["done", "failed"]),
    judge=st.sampled_from([None, "", "rules", "openai"]),
    judge_model=st.sampled_from([None, "", "big"]),
    judge_remarks=st.none() | st.lists(st.sampled_from(["mass_clipped:a", "mass_clipped:b", "cut"]), max_size=3),
    usable=st.none() | st.booleans(),
    quality_score=st.integers(0, 10),
    rules_usable=st.none() | st.booleans(),
    rules_score=st.none() | st.integers(0, 10),
    rules_names_share=SHARES,
    rules_mass_ratio=st.floats(0.1, 10) | st.just(math.inf),
    rules_tasks=st.integers(0, 5),
    rules_shared_tasks=st.integers(0, 5),
)


def state_of(losses=(), timings=()):
    lost = build_table(losses, table_of(["status", "stage", "reason", "error_kind"]))
    return BuildState(len(losses), 1, 1, (0,), "", lost, build_table(timings, TIMINGS), lost)


@given(LOSSES)
def test_losses_are_counted_by_what_befell_each_scene(rows):
    state = state_of(rows)
    lost = Counter(
        (row["status"], row["stage"], row["reason"] or row["error_kind"] or "")
        for row in rows
        if row["status"] != "done"
    )
    assert list(state.count_losses().items()) == sorted(lost.items(), key=lambda item: (-item[1], item[0]))
    assert (state.done, state.dropped, state.failed) == tuple(
        sum(row["status"] == status for row in rows) for status in ("done", "dropped", "failed")
    )


@given(st.lists(st.tuples(st.sampled_from(STAGES), st.floats(0, 1e4)), max_size=40))
def test_stage_costs_are_those_of_the_sorted_times(ran):
    costs = state_of(timings=[{"scene_id": "a", "stage": stage, "cpu_s": cpu_s} for stage, cpu_s in ran])
    times: dict[str, list[float]] = {}
    for stage, cpu_s in ran:
        times.setdefault(stage, []).append(cpu_s)
    found = costs.compute_stage_costs()
    assert [cost.stage for cost in found] == list(times)
    for cost, seconds in zip(found, times.values(), strict=True):
        assert (cost.scenes, cost.median_cpu_s) == (len(seconds), median(seconds))
        assert cost.p90_cpu_s == sorted(seconds)[math.ceil(0.9 * len(seconds)) - 1]
        assert cost.total_cpu_s == pytest.approx(sum(seconds))


@given(COSTS)
def test_costs_of_models_are_added_scene_by_scene(rows):
    sums = dict.fromkeys(("detector", "judge"), NO_COST)
    for row in rows:
        for role in sums:
            figures = (row[f"{role}_{name}"] or 0 for name in ("calls", "input_tokens", "output_tokens", "usd"))
            sums[role] += ModelCost(*figures)
    expected = {role: cost for role, cost in sums.items() if cost}
    assert sum_model_costs(build_table(rows, table_of(COST_COLUMNS))) == expected


@given(JUDGED)
def test_judgements_are_summarized_scene_by_scene(rows):
    found = summarize_judgements(build_table(rows, table_of(JUDGEMENT_COLUMNS)))
    done = [row for row in rows if row["status"] == "done"]
    judges = Counter(": ".join(filter(None, (row["judge"] or "none", row["judge_model"]))) for row in done)
    remarks = Counter(remark.partition(":")[0] for row in done for remark in row["judge_remarks"] or ())
    assert list(found.judges.items()) == sorted(judges.items())
    verdicts = [row["usable"] for row in done if row["usable"] is not None]
    assert (found.judged, found.usable) == (len(verdicts), sum(verdicts))
    assert list(found.remarks.items()) == sorted(remarks.items(), key=lambda item: (-item[1], item[0]))
    compared = [row for row in done if row["rules_score"] is not None]
    if not compared:
        assert found.agreement is None
        return
    assert found.agreement.scenes == len(compared)
    assert found.agreement.usable_share == mean(row["usable"] == row["rules_usable"] for row in compared)
    assert found.agreement.score_difference == median(row["quality_score"] - row["rules_score"] for row in compared)
    assert found.agreement.names_share == mean(row["rules_names_share"] for row in compared)
    assert found.agreement.mass_ratio == median(row["rules_mass_ratio"] for row in compared)
    shared, tasks = (sum(row[name] for row in compared) for name in ("rules_shared_tasks", "rules_tasks"))
    assert found.agreement.tasks_share == shared / max(tasks, 1)


@given(st.lists(st.floats(0, 1e5), max_size=30))
def test_many_durations_count_as_one_after_the_other(seconds):
    together, single = Durations(), Durations()
    together.add_all(pa.array(seconds, pa.float64()).to_numpy())
    for value in seconds:
        single.add(value)
    assert together.buckets == single.buckets
    assert together.total_s == pytest.approx(single.total_s)


@pytest.mark.heavy
def test_journals_take_precedence_over_shards(tmp_path):
    manifest, out = write_manifest(tmp_path / "m.parquet", ["fine", "empty", "sad"] * 4), tmp_path / "out"
    build(manifest, out)
    whole = read_build_state(out)
    assert (whole.committed, whole.remaining, whole.scenes["tar_size"].null_count) == (3, 0, 0)
    by_scene = Counter(whole.timings["scene_id"].to_pylist())
    reopened = [row["scene_id"] for row in scenes(out) if row["status"] != "done"][:2]
    reopen_scenes(out, reopened)
    state = read_build_state(out)
    assert set(whole.scenes["scene_id"].to_pylist()) - set(state.scenes["scene_id"].to_pylist()) == set(reopened)
    assert (state.remaining, state.stored.num_rows) == (2, 12)
    kept = {scene_id: count for scene_id, count in by_scene.items() if scene_id not in reopened}
    assert Counter(state.timings["scene_id"].to_pylist()) == kept
    shutil.rmtree(out)
    run_build(replace(request(manifest, out), limit=6), Silent())
    half = read_build_state(out)
    assert (half.committed, half.scenes.num_rows, half.scenes["tar_size"].null_count) == (1, 6, 2)
    assert half.scenes["scene_id"].to_pylist() == whole.scenes["scene_id"].to_pylist()[:6]
    assert Counter((lost.status, lost.stage, lost.why) for lost in half.list_lost()) == half.count_losses()
    assert {lost.shard for lost in half.list_lost()} == {0, 1}
    few = read_build_state(out, ["status"], ["stage"])
    assert (few.scenes.column_names, few.timings.column_names) == (["status"], ["stage"])
    assert few.scenes["status"].to_pylist() == half.scenes["status"].to_pylist()


@pytest.mark.slow  # starts processes to read thousands of rows
@pytest.mark.heavy
def test_processes_read_what_one_process_reads(tmp_path, monkeypatch):
    manifest, out = write_manifest(tmp_path / "m.parquet", ["fine", "empty", "sad"] * 8), tmp_path / "out"
    run_build(replace(request(manifest, out), limit=22), Silent())
    reopen_scenes(out, [scenes(out)[4]["scene_id"]])
    alone = read_build_state(out)
    monkeypatch.setattr(scan, "_SHARDS_PER_PROCESS", 2)
    monkeypatch.setattr(scan.os, "cpu_count", lambda: 3)
    together = read_build_state(out)
    assert (together.committed, together.published) == (alone.committed, alone.published) == (4, (0, 1, 2, 3, 4))
    for name in ("scenes", "timings", "stored"):
        assert getattr(together, name).equals(getattr(alone, name))
    damaged = shard_path(out, "timings", 3)
    damaged.write_bytes(damaged.read_bytes()[:-9])
    with pytest.raises(BuildError, match=r"timings/shard-00003\.parquet is damaged"):
        read_build_state(out)
