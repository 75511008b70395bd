"""A dataset that grows by its trajectories is the one that was built with them, whatever stood in between."""

import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from schemas.codec import encode
from schemas.config import Config, RunConfig, TrajectoriesConfig
from schemas.scene import ExportedScene
from tableverse_factory.cli.status import status
from tableverse_factory.core.errors import BuildError, ConfigError, InputError
from tableverse_factory.dataset.committed_scene import load_exported_scene
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.dataset.journals import WORK
from tableverse_factory.delivery.license_filter import write_filtered_dataset
from tableverse_factory.rebuild import config_from_run
from tableverse_factory.run_record import read_run
from tests.helpers.builds import QUICK, Silent, digests, finish, kill, request, scenes, wait_until, write_manifest
from tests.helpers.paths import HELPERS
from workers.run import BuildRequest, run_build
from workers.state.checkpoint_store import CHECKPOINTS, CheckpointStore

NAMES = ["fine", "empty", "fine", "fell", "idle", "sad", "fine", "fine", "empty", "empty", "empty", "empty"]


PATIENT = {**QUICK, "deadline_s": 60.0, "memory_mb": 1000}
_SETS = [w for key, value in PATIENT.items() for w in ("--set", f"run.{key}={value}")] + ["--stages", "+trajectories"]


def short(folder: Path, out: str, **changes: object) -> BuildRequest:
    return replace(
        request(folder / "m.parquet", folder / out, **PATIENT), pipeline="tests.helpers.long_pipeline:SHORT", **changes
    )


def long(folder: Path, out: str, **changes: object) -> BuildRequest:
    return replace(short(folder, out), pipeline="tests.helpers.long_pipeline:LONG", **changes)


def afterwards(folder: Path, out: str, *overrides: str, **changes: object) -> BuildRequest:
    """What `tableverse trajectories` asks for."""
    config = config_from_run(read_run(folder / out / "run.json"), "trajectories", overrides)
    asked = replace(long(folder, out), manifest=None, config=config, cache_dir=folder / "cache")
    return replace(asked, **changes)


def with_section(section: TrajectoriesConfig) -> Config:
    return Config(run=RunConfig(**PATIENT), trajectories=section)


def start(*arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, str(HELPERS / "run_command.py"), *map(str, arguments)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, text=True, env=environment, start_new_session=True, **pipes)


def wait_for_plan(process: subprocess.Popen[str], mark: Path) -> None:
    """Until a stage has begun on a scene."""
    wait_until(lambda: process.poll() is not None or mark.exists())
    assert process.poll() is None, process.stderr.read()


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with the dataset `short`, and `long` that was built with trajectories from the start."""
    folder = tmp_path_factory.mktemp("made")
    write_manifest(folder / "m.parquet", NAMES)
    run_build(short(folder, "short"), Silent())
    run_build(long(folder, "long"), Silent())
    return folder


@pytest.fixture
def copy(made, tmp_path) -> Path:
    """The same folder, to be changed."""
    shutil.copytree(made, tmp_path / "copy")
    return tmp_path / "copy"


def test_afterwards_gives_the_bytes_of_a_build_with_them_and_runs_nothing_else(copy, marks):
    run_build(afterwards(copy, "short"), Silent())
    assert {name.partition(".")[2] for name in marks()} == {"plan"}
    assert digests(copy / "short") == digests(copy / "long")
    stages = [
        Counter(row["stage"] for path in (copy / out / "timings").iterdir() for row in pq.read_table(path).to_pylist())
        for out in ("short", "long")
    ]
    assert stages[0] == stages[1], "what the earlier stages took is still known"
    again = run_build(afterwards(copy, "short"), Silent())
    assert again.tally.before == again.tally.total, "the same command again has nothing to do"
    assert not marks()


def test_what_was_passed_on_without_records_and_manifest_will_do(copy, marks):
    shutil.rmtree(copy / "short" / CHECKPOINTS)
    (copy / "m.parquet").unlink()
    run_build(afterwards(copy, "short", keep=False), Silent())
    assert {name.partition(".")[2] for name in marks()} == {"plan"}
    assert digests(copy / "short") == digests(copy / "long")
    assert not [path for path in (copy / "short" / CHECKPOINTS).rglob("*") if path.is_file()]


def test_a_scene_read_back_is_the_record_that_was_written(made):
    long_records, read = CheckpointStore(made / "long" / CHECKPOINTS), 0
    for row in scenes(made / "long"):
        names = [name for name in long_records.index(row["shard"]) if f"/{row['scene_id']}.pack." in name]
        if row["status"] != "done":
            assert load_exported_scene(made / "long", row["shard"], row["scene_id"]) is None
            continue
        original = long_records.read(names[0])
        assert original is not None
        for out in ("long", "short"):
            again = load_exported_scene(made / out, row["shard"], row["scene_id"])
            assert encode(again) == encode(original.record)
            read += 1
    assert read == 10
    assert load_exported_scene(made / "long", 77, "scene_000") is None


def test_the_manifest_in_hand_a_build_goes_on_to_the_longer_line_and_not_back(copy, marks):
    run_build(long(copy, "short"), Silent())
    assert {name.partition(".")[2] for name in marks()} == {"plan"}
    assert digests(copy / "short") == digests(copy / "long")
    before = digests(copy / "long")
    with pytest.raises(BuildError, match=r"was begun with the stage trajectories: add --stages \+trajectories"):
        run_build(short(copy, "long"), Silent())
    assert digests(copy / "long") == before


@pytest.mark.slow
def test_an_unfinished_build_grows_with_its_manifest_only(copy, marks):
    run_build(short(copy, "new", limit=6), Silent())
    marks()
    with pytest.raises(BuildError, match=r"new is not finished: 2 of 3 shards are missing"):
        run_build(afterwards(copy, "new"), Silent())
    run_build(long(copy, "new"), Silent())
    counts = marks()
    assert set(counts.values()) == {1}
    assert not {name for name in counts if name.startswith(("scene_000", "scene_002")) and not name.endswith(".plan")}
    assert not {name for name in counts if name.startswith("scene_004") and not name.endswith(".plan")}, "its journal"
    assert digests(copy / "new") == digests(copy / "long")


def test_another_robot_needs_again_and_then_nothing_before_runs(copy, marks):
    before = digests(copy / "long")
    with pytest.raises(BuildError, match=r"trajectories\.tries was 12 and is now 3.*add --again to compute"):
        run_build(afterwards(copy, "long", "trajectories.tries=3"), Silent())
    with pytest.raises(ConfigError, match=r"'settle\.max_time_s=9': only trajectories\.… can be set here"):
        afterwards(copy, "long", "settle.max_time_s=9")
    assert digests(copy / "long") == before
    run_build(afterwards(copy, "long", "trajectories.tries=3", from_stage="trajectories"), Silent())
    assert {name.partition(".")[2] for name in marks()} == {"plan"}
    run_build(replace(long(copy, "fresh"), config=with_section(TrajectoriesConfig(tries=3))), Silent())
    assert digests(copy / "long") == digests(copy / "fresh")


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 4])
def test_kill_9_and_the_same_command_again(tmp_path, marks, times):
    names = ["fine", "long_plan", "fine", "fine", "long_plan", "fine"]
    write_manifest(tmp_path / "m.parquet", names)
    run_build(short(tmp_path, "out"), Silent())
    run_build(long(tmp_path, "whole"), Silent())
    marks()
    for turn in range(times):
        process = start("trajectories", tmp_path / "out", "--executor", "local")
        wait_for_plan(process, tmp_path / "marks" / f"scene_00{(1, 4)[turn > 0]}.plan")
        kill(process)
        if turn == 0:
            counts = marks()
    code, errors = finish(start("trajectories", tmp_path / "out", "--executor", "local"))
    assert code == 0, errors
    counts += marks()
    assert {name.partition(".")[2] for name in counts} == {"plan"}
    assert counts["scene_000.plan"] == 1, "what was finished before the kill is not planned again"
    assert digests(tmp_path / "out") == digests(tmp_path / "whole")


@pytest.mark.slow  # three builds; tests above do it in this process
def test_a_build_from_the_command_line_with_stages_and_from_that_stage_again(copy, marks):
    arguments = ("build", copy / "m.parquet", copy / "told", "--executor", "local")
    sets = [f"run.{key}={value}" for key, value in PATIENT.items()]
    options = [word for text in sets for word in ("--set", text)]
    code, errors = finish(start(*arguments, *options, "--stages", "+films"))
    assert code == 1
    assert "--stages '+films': give +trajectories" in errors
    code, errors = finish(start(*arguments, *options, "--stages", "+trajectories"))
    assert code == 3, errors  # one scene is sad
    assert digests(copy / "told") == digests(copy / "long")
    marks()
    code, errors = finish(start(*arguments, *options, "--from", "trajectories"))
    assert code == 3, errors
    assert {name.partition(".")[2] for name in marks()} == {"plan"}
    assert digests(copy / "told") == digests(copy / "long")


@pytest.mark.slow  # tests/stages/trajectories has the stage, test_poison.py the build
def test_a_planner_that_crashes_or_hangs_costs_no_scene(tmp_path, marks):
    names = ["fine", "crash_plan", "hang_plan", "crash_plan_once", "drop_plan"]
    write_manifest(tmp_path / "m.parquet", names)
    asked = replace(long(tmp_path, "out"), config=with_section(TrajectoriesConfig(deadline_s=4.0)))
    run_build(asked, Silent())
    rows = scenes(tmp_path / "out")
    assert [row["status"] for row in rows] == ["done"] * 5
    assert [row["attempts"] for row in rows] == [1, 2, 2, 1, 1]
    assert [row["n_trajectories"] for row in rows] == [2] * 5
    assert [row["n_successes"] for row in rows] == [1, 0, 0, 1, 0]
    dataset = open_dataset(tmp_path / "out")
    why = {row["scene_id"]: row["reason"] for row in dataset.trajectories.to_table().to_pylist() if row["reason"]}
    assert [why[f"scene_{k:03d}"] for k in (1, 2, 4)] == ["crash", "timeout", "no_robot"]
    assert dict(dataset.scene("scene_001").files()).keys() == {"assets/pieces.bin", "meta.json", "scene.xml"}
    assert run_build(asked, Silent()).tally.before == 5


@pytest.mark.slow  # the test below stops where a model dies, and goes on
def test_a_model_that_does_not_answer_leaves_scenes_for_a_later_run(tmp_path, marks, monkeypatch):
    write_manifest(tmp_path / "m.parquet", ["fine", "mute_plan", "fine", "empty"])
    asked = long(tmp_path, "out")
    first = run_build(asked, Silent())
    assert (first.tally.postponed, first.tally.accounted, scenes(tmp_path / "out")) == (1, 3, [])
    code, errors = finish(start("build", tmp_path / "m.parquet", tmp_path / "out", "--executor", "local", *_SETS))
    assert code == 3, errors
    assert "scene_001: trajectories is left for a later run: " in errors
    marks()
    monkeypatch.setenv("TINY_LINE_ANSWERS", "1")
    assert run_build(asked, Silent()).tally.postponed == 0
    assert set(marks()) == {"scene_001.plan"}
    assert [row["n_successes"] for row in scenes(tmp_path / "out")] == [1, 1, 1, None]


def test_what_was_proven_outlives_a_model_that_dies(tmp_path, marks, monkeypatch):
    write_manifest(tmp_path / "m.parquet", ["mute_plan"] * 7)
    monkeypatch.setenv("TINY_LINE_ANSWERS", "1")
    asked = long(tmp_path, "out")
    run_build(asked, Silent())
    before = digests(tmp_path / "out")
    monkeypatch.delenv("TINY_LINE_ANSWERS")
    with pytest.raises(
        BuildError, match=r"does not answer; 5 scenes in a row were left\. Run the same command to go on"
    ):
        run_build(afterwards(tmp_path, "out", from_stage="trajectories"), Silent())
    assert {name: value for name, value in digests(tmp_path / "out").items() if not name.startswith(WORK)} == before
    monkeypatch.setenv("TINY_LINE_ANSWERS", "1")
    run_build(afterwards(tmp_path, "out", from_stage="trajectories"), Silent())
    assert digests(tmp_path / "out") == before


def test_rows_and_files_of_a_scene(made):
    dataset = open_dataset(made / "long")
    scene = dataset.scene("scene_000")
    first, second = scene.trajectories()
    assert first.success
    assert not second.success
    assert scene.files()["trajectories/task_000.npz"] == first._data
    with pytest.raises(InputError, match="no arrays of tableverse-trajectory-1"):
        first.recording()  # the tiny pipeline writes noise
    with pytest.raises(InputError, match="task_001 has no motion: no_grasp"):
        scene.trajectory("task_001").recording()
    with pytest.raises(InputError, match="no trajectory of 'task_009'; tried were: task_000, task_001"):
        scene.trajectory("task_009")
    counts = Counter(row["scene_id"] for row in dataset.trajectories.to_table().to_pylist())
    assert counts == {f"scene_{k:03d}": 2 for k in (0, 2, 6, 7)}
    assert sorted(path.name for path in (made / "long/trajectories").iterdir()) == [
        "shard-00000.parquet", "shard-00001.parquet",
    ]  # fmt: skip


def test_a_dataset_without_trajectories_is_as_it_was(made):
    assert not (made / "short/trajectories").exists()
    dataset = open_dataset(made / "short")
    assert dataset.trajectories.to_table().num_rows == 0
    assert dataset.scene("scene_000").trajectories() == ()
    assert {row["n_trajectories"] for row in scenes(made / "short")} == {None}
    counted = {row["scene_id"]: row["n_trajectories"] for row in scenes(made / "long") if row["status"] == "done"}
    assert counted["scene_004"] == 0
    assert counted["scene_000"] == 2


def test_a_dataset_of_an_older_version_opens_and_grows_and_says_so(copy):
    """Before this version: no such columns, no section of the configuration, other versions."""
    for path in (copy / "short/scenes").iterdir():
        table = pq.read_table(path)
        pq.write_table(table.drop_columns(["n_trajectories", "n_successes"]), path)
    run = read_run(copy / "short/run.json")
    del run["config"]["trajectories"]
    run["versions"] |= {"mujoco": "3.0.0", "tableverse-factory": "0.3.0"}
    (copy / "short/run.json").write_text(json.dumps(run))
    assert open_dataset(copy / "short").scene("scene_000").trajectories() == ()
    run_build(afterwards(copy, "short", limit=2), Silent())
    run_build(afterwards(copy, "short"), Silent())
    ours, theirs = read_run(copy / "short/run.json"), read_run(copy / "long/run.json")
    assert ours["versions"]["mujoco"] == "3.0.0"
    assert ours.pop("afterwards") == {"versions": theirs["versions"]}
    assert {**ours, "versions": theirs["versions"]} == theirs
    untouched = {"run.json", "scenes/shard-00002.parquet"}  # a shard in which no scene was done stays as it was
    trees = [{k: v for k, v in digests(copy / out).items() if k not in untouched} for out in ("short", "long")]
    assert trees[0] == trees[1]
    assert open_dataset(copy / "short").scenes.to_table() == open_dataset(copy / "long").scenes.to_table()


def test_what_was_published_grows_too_and_what_grew_is_published(copy):
    write_filtered_dataset(copy / "short", copy / "public", "permissive")
    write_filtered_dataset(copy / "long", copy / "public_long", "permissive")
    run_build(afterwards(copy, "public"), Silent())
    trees = [{k: v for k, v in digests(copy / out).items() if k != "run.json"} for out in ("public", "public_long")]
    assert trees[0] == trees[1]
    runs = [read_run(copy / out / "run.json") for out in ("public", "public_long")]
    assert [run.pop("published")["scenes"] for run in runs] == [len(NAMES)] * 2
    assert runs[0] == runs[1]
    assert open_dataset(copy / "public").trajectories.count_rows() == 8


def test_a_manifest_that_cannot_be_restored_is_asked_for(copy):
    run = read_run(copy / "short/run.json")
    run["manifest"]["sha256"] = "0" * 64
    (copy / "short/run.json").write_text(json.dumps(run))
    with pytest.raises(BuildError, match=r"the manifest cannot be restored .*tableverse build MANIFEST OUT --stages"):
        run_build(afterwards(copy, "short"), Silent())


def test_a_lost_table_of_trajectories_is_noticed_and_mended(copy):
    before, lost = digests(copy / "long"), copy / "long/trajectories/shard-00001.parquet"
    lost.unlink()
    with pytest.raises(BuildError, match=rf"{lost} is damaged .*missing.*: delete scenes/shard-00001\.parquet"):
        run_build(long(copy, "long"), Silent())
    (copy / "long/scenes/shard-00001.parquet").unlink()
    run_build(long(copy, "long"), Silent())
    assert digests(copy / "long") == before


@pytest.mark.slow
def test_a_table_goes_where_a_shard_has_no_trajectories_any_more(copy):
    run_build(afterwards(copy, "long", "trajectories.max_tasks=0", from_stage="trajectories"), Silent())
    assert not list((copy / "long/trajectories").iterdir())
    assert open_dataset(copy / "long").trajectories.count_rows() == 0
    counted = {row["scene_id"]: row["n_trajectories"] for row in scenes(copy / "long")}
    assert counted["scene_000"] == 0
    assert counted["scene_001"] is None
    assert list(open_dataset(copy / "long").scene("scene_000").files()) == [
        "assets/pieces.bin",
        "meta.json",
        "scene.xml",
    ]


@pytest.mark.slow
def test_pointers_left_behind_are_never_taken_for_more_than_they_are(copy, marks):
    run_build(afterwards(copy, "short", limit=1), Silent())
    records = CheckpointStore(copy / "short" / CHECKPOINTS)
    pointers = [
        n
        for n, at in records.index(0).items()
        if at.size < 1000 and isinstance(records.read(at.location).record, ExportedScene)
    ]
    assert len(pointers) == 2
    marks()
    run_build(long(copy, "short", from_stage="export"), Silent())
    assert {name.partition(".")[2] for name in marks()} == {"pack", "plan"}
    assert digests(copy / "short") == digests(copy / "long")


def test_a_scene_that_is_whole_is_never_computed_from_a_picture_that_may_be_gone(copy, marks):
    run_build(afterwards(copy, "short", limit=1), Silent())
    shutil.rmtree(copy / "short" / CHECKPOINTS)
    marks()
    with pytest.raises(BuildError, match=r"look would have to run again.*delete \.work/, and add --again"):
        run_build(afterwards(copy, "short"), Silent())
    assert not marks()
    shutil.rmtree(copy / "short" / WORK)
    run_build(afterwards(copy, "short", from_stage="trajectories"), Silent())
    assert {name.partition(".")[2] for name in marks()} == {"plan"}
    assert digests(copy / "short") == digests(copy / "long")


def test_status_says_how_a_dataset_goes_on_growing(copy, capsys):
    run_build(afterwards(copy, "short", limit=2), Silent())
    status(str(copy / "short"), as_json=False, watch=False, every=5.0)
    said = " ".join(capsys.readouterr().out.split())
    assert f"to go on: tableverse trajectories {copy}/short" in said
    assert "rows of trajectories appear when their shard is complete" in said


@pytest.mark.slow
def test_status_of_an_unfinished_build_asks_for_its_manifest(copy, capsys):
    run_build(long(copy, "new", limit=3), Silent())
    status(str(copy / "new"), as_json=False, watch=False, every=5.0)
    said = capsys.readouterr().out
    assert "to go on: tableverse build MANIFEST" in said
    assert "rows of trajectories" not in said
