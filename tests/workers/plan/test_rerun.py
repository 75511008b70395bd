"""Nothing is computed twice: not after a kill, not by `--from`, and what was left out by a limit is computed later."""

import shutil
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from schemas.config import Config, ExportConfig, RectifyConfig, RunConfig, SettleConfig
from tableverse_factory.core.errors import BuildError, ConfigError
from tableverse_factory.dataset.shard_plan import check_shards, parse_shards
from tests.helpers import tiny_pipeline
from tests.helpers.builds import (
    QUICK,
    Silent,
    build,
    digests,
    finish,
    kill,
    request,
    scenes,
    start,
    wait_until,
    write_manifest,
)
from workers.plan.rerun import find_restart_points
from workers.progress.build_state import read_build_state
from workers.run import run_build
from workers.state.checkpoint_store import CHECKPOINTS, CheckpointStore

pytestmark = pytest.mark.heavy

NAMES = ["fine", "empty", "fine", "fell", "fine", "sad", "fine", "fine", "fine"]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with a manifest of `NAMES` and its dataset."""
    folder = tmp_path_factory.mktemp("made")
    build(write_manifest(folder / "m.parquet", NAMES), folder / "out")
    return folder


@pytest.fixture
def built(made, tmp_path) -> tuple[Path, Path]:
    """A copy of both, to be changed."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path / "m.parquet", tmp_path / "out"


def stages_of(counts: Counter[str]) -> set[str]:
    return {name.partition(".")[2] for name in counts}


def changed(manifest: Path, out: Path, from_stage: str | None = None, **sections: object):
    asked = request(manifest, out)
    config = Config(run=RunConfig(**QUICK), **sections)
    return replace(asked, config=config, from_stage=from_stage)


def test_a_change_of_one_section_runs_that_stage_and_what_follows_and_nothing_before(built, tmp_path, marks):
    manifest, out = built
    marks()
    settle = SettleConfig(max_time_s=7.0)
    run_build(changed(manifest, out, "settle", settle=settle), Silent())
    counts = marks()
    assert stages_of(counts) == {"settle", "pack"}
    assert set(counts.values()) == {1}
    assert len({name.partition(".")[0] for name in counts}) == 7, "the empty and the sad scene never came so far"
    run_build(changed(manifest, tmp_path / "fresh", settle=settle), Silent())
    assert digests(out) == digests(tmp_path / "fresh")


def test_without_from_it_is_refused_and_told_and_a_later_stage_is_not_enough(built):
    manifest, out = built
    before = digests(out)
    rectify = RectifyConfig(clearance_m=0.002)
    with pytest.raises(
        BuildError, match=r"config\.rectify\.clearance_m was 0\.0005 and is now 0\.002.* --from rectify"
    ):
        run_build(changed(manifest, out, rectify=rectify), Silent())
    with pytest.raises(BuildError, match=r"clearance_m changed, which cut reads already: give --from rectify"):
        run_build(changed(manifest, out, "export", rectify=rectify), Silent())
    with pytest.raises(BuildError, match=r"no such stage for a capture; there are observe, rectify, settle, export"):
        run_build(changed(manifest, out, "polish", rectify=rectify), Silent())
    seeded = replace(changed(manifest, out, "observe"), config=Config(run=RunConfig(**QUICK, seed=3)))
    with pytest.raises(BuildError, match=r"config\.run\.seed changed, which no --from can make good"):
        run_build(seeded, Silent())
    assert digests(out) == before


def test_from_a_stage_without_any_change_computes_it_again(built, marks):
    manifest, out = built
    before = digests(out)
    marks()
    run_build(changed(manifest, out, "export"), Silent())
    assert stages_of(marks()) == {"pack"}
    assert digests(out) == before


@pytest.mark.slow  # tests/integration/builds/test_again_stopped.py counts runs after a kill
def test_a_stage_that_was_finished_before_a_kill_is_not_run_again(tmp_path, marks):
    manifest, out = write_manifest(tmp_path / "m.parquet", ["fine", "slow_2", "fine"]), tmp_path / "out"
    process = start(manifest, out)
    wait_until(lambda: (tmp_path / "marks" / "scene_001.cut").exists())
    kill(process)
    assert marks()["scene_001.look"] == 1
    build(manifest, out)
    counts = marks()
    assert counts["scene_001.cut"] == 1
    assert not {"scene_001.look", "scene_000.look", "scene_000.cut"} & set(counts)
    build(manifest, tmp_path / "whole")
    assert digests(out) == digests(tmp_path / "whole")


@pytest.mark.parametrize("damage", ["torn", "lost", pytest.param("flipped", marks=pytest.mark.slow)])
def test_damaged_and_lost_records_cost_time_only(built, marks, damage):
    manifest, out = built
    before = digests(out)
    for path in (out / CHECKPOINTS).glob("*/*"):
        whole = bytearray(path.read_bytes())
        if damage == "torn":
            del whole[len(whole) // 2 :]
        whole[len(whole) // 2] ^= 1
        path.write_bytes(whole) if damage != "lost" else path.unlink()
    marks()
    run_build(changed(manifest, out, "settle"), Silent())
    assert sum(name.endswith((".look", ".cut")) for name in marks()) >= 1
    assert {row["attempts"] for row in scenes(out)} == {1}
    assert digests(out) == before


def test_records_that_nobody_wants_go_with_their_shard(built, tmp_path):
    manifest, kept = built
    run_build(replace(request(manifest, tmp_path / "other"), keep=False), Silent())
    assert digests(tmp_path / "other") == digests(kept)
    assert [path for path in (kept / CHECKPOINTS).rglob("*") if path.is_file()]
    assert [path for path in (tmp_path / "other" / CHECKPOINTS).rglob("*") if path.is_file()] == []


def test_a_limit_and_a_choice_of_shards_leave_the_rest_for_later(built, tmp_path, marks):
    manifest, whole = built
    out = tmp_path / "limited"
    asked = request(manifest, out)
    run_build(replace(asked, limit=2), Silent())
    assert {name.partition(".")[0] for name in marks()} == {"scene_000", "scene_001"}
    assert read_build_state(out).remaining == len(NAMES) - 2
    assert not (out / "README.md").exists()
    run_build(replace(asked, shards=frozenset({1, 2})), Silent())
    assert {name.partition(".")[0] for name in marks()} == {f"scene_{i:03d}" for i in (4, 5, 6, 7, 8)}
    assert read_build_state(out).committed == 2
    run_build(asked, Silent())
    assert digests(out) == digests(whole)


def test_a_stage_is_found_by_its_own_name_and_by_its_section():
    for name in ("rectify", "cut"):
        assert find_restart_points(tiny_pipeline.PIPELINES, {"layout"}, name) == {"layout": 1}


def test_a_list_of_shards():
    assert parse_shards("3-7,9") == {3, 4, 5, 6, 7, 9}
    assert parse_shards(" 0 ") == {0}
    for text in ("", "7-3", "a", "1-", "-1", "1;2"):
        with pytest.raises(ConfigError, match="numbers and ranges"):
            parse_shards(text)
    with pytest.raises(ConfigError, match="largest number that is taken is 999999"):
        parse_shards("0-99999999999")


def test_shards_that_the_plan_does_not_have_are_refused_before_anything_is_written(tmp_path):
    manifest = write_manifest(tmp_path / "m.parquet", ["fine"] * 9)  # four scenes a shard
    with pytest.raises(ConfigError, match="--shards 3: the plan has shards 0 to 2"):
        run_build(replace(request(manifest, tmp_path / "out"), shards={2, 7, 3}), Silent())
    assert not (tmp_path / "out").exists()
    check_shards({0, 2}, 9, 4)
    check_shards(None, 0, 4)
    with pytest.raises(ConfigError, match="no shards"):
        check_shards({0}, 0, 4)


def test_a_kill_while_a_build_begins_again_loses_nothing(built, monkeypatch):
    """Between taking scenes back and the new run.json the old build can still go on."""
    manifest, out = built
    before = digests(out)

    def die(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("workers.plan.start.write_run", die)
        with pytest.raises(KeyboardInterrupt):
            run_build(changed(manifest, out, "settle", settle=SettleConfig(max_time_s=7.0)), Silent())
    build(manifest, out)
    assert digests(out) == before


def test_a_record_is_whole_or_none(tmp_path):
    records = CheckpointStore(tmp_path)
    big, name = bytes(range(256)) * 400, "shard-00000/a.b.cut.0"
    records.write("shard-00000/a.b.look.0", b"first")
    records.write(name, big)
    (pack,) = (tmp_path / "shard-00000").iterdir()
    whole = pack.read_bytes()
    assert len(whole) < len(big)
    place = records.index(0)[name].location
    assert records.read(place).record == records.read(name).record == big
    for end in range(len(whole)):
        pack.write_bytes(whole[:end])
        assert name not in records.index(0)
        assert records.read(place) is None
        assert records.read(name) is None
    for at in range(int(place.rpartition("@")[2]), len(whole)):
        flipped = bytearray(whole)
        flipped[at] ^= 1
        pack.write_bytes(flipped)
        assert records.read(place) is None, f"byte {at}"
    pack.write_bytes(whole)
    assert records.read("shard-00000/b.cut.0") is None


def test_records_of_several_processes_are_one_and_can_be_thinned_out(tmp_path):
    writers = [CheckpointStore(tmp_path) for _ in range(3)]
    for number, writer in enumerate(writers):
        for stage in ("look", "cut", "fall"):
            writer.write(f"shard-00007/scene_{number}.{stage}.0", f"{number} {stage}".encode())
    writers[0].write("shard-00008/scene_9.cut.0", b"elsewhere")
    reader = CheckpointStore(tmp_path)
    assert len(reader.index(7)) == 9
    reader.delete(7, {"cut", "fall"})
    assert set(reader.index(7)) == {f"shard-00007/scene_{number}.look.0" for number in range(3)}
    assert reader.read("shard-00007/scene_1.look.0").record == b"1 look"
    reader.delete(7)
    assert reader.index(7) == {}
    assert set(reader.index(8)) == {"shard-00008/scene_9.cut.0"}


def test_packs_are_closed_and_strange_names_left_alone(tmp_path):
    records = CheckpointStore(tmp_path)
    for shard in range(20):
        records.write(f"shard-{shard:05d}/a.cut.0", b"x" * 1000)
    assert not [link for link in Path("/proc/self/fd").iterdir() if str(tmp_path) in _target(link)], "all are closed"
    records.delete(19)
    records.write("shard-00019/a.cut.0", b"again")
    assert records.read("shard-00019/a.cut.0").record == b"again"
    records.write("shard-00019/strange", b"no stage")
    assert set(records.index(19)) == {"shard-00019/a.cut.0"}
    records.delete(19, {"cut"})
    assert records.index(19) == {}


def _target(link: Path) -> str:
    try:
        return str(link.readlink())
    except OSError:
        return ""


@pytest.mark.slow  # waits for deadlines; tests/workers/sandbox has them
def test_deadlines_belong_to_their_stage(tmp_path):
    manifest = write_manifest(tmp_path / "m.parquet", ["slow_1", "fine"])
    asked = changed(
        manifest, tmp_path / "out", rectify=RectifyConfig(deadline_s=0.2), export=ExportConfig(deadline_s=9)
    )
    started = time.monotonic()
    run_build(asked, Silent())
    assert time.monotonic() - started < 60
    assert [(row["status"], row["stage"], row["error_kind"]) for row in scenes(tmp_path / "out")] == [
        ("failed", "cut", "timeout"),
        ("done", "pack", None),
    ]
    assert "no answer within 0.2 s" in scenes(tmp_path / "out")[0]["detail"]
    code, errors = finish(start(manifest, tmp_path / "patient"))
    assert code == 0, errors
