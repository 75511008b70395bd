"""Watching a build from outside: the same figures as a full survey at every moment, and each file read once."""

import shutil
import time
from dataclasses import replace
from pathlib import Path

import pytest

from tableverse_factory.core.errors import BuildError
from tableverse_factory.dataset.journals import journal_path
from tableverse_factory.dataset.shard_plan import read_plan
from tests.helpers.builds import Silent, build, compute, finish, request, start, wait_until, write_manifest
from workers.plan.invalidate import reopen_scenes
from workers.plan.read_manifest import read_manifest
from workers.progress import follow
from workers.progress.build_state import read_build_state
from workers.progress.follow import BuildFollower
from workers.run import run_build
from workers.state.commit import stage_shard
from workers.state.ledger import Ledger

pytestmark = pytest.mark.heavy

NAMES = ["fine", "empty", "sad", "fell", "fine", "fine", "empty", "sad", "fine"]


def same_as_survey(out: Path, tally) -> None:
    found = read_build_state(out)
    assert (tally.count("done"), tally.count("dropped"), tally.count("failed")) == (
        found.done, found.dropped, found.failed,
    )  # fmt: skip
    assert (tally.accounted, tally.committed, tally.shards) == (
        found.total - found.remaining, found.committed, found.shards,
    )  # fmt: skip
    for cost in found.compute_stage_costs():
        assert tally.wall[cost.stage].count == cost.scenes
        assert tally.cpu[cost.stage].total_s == pytest.approx(cost.total_cpu_s)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    build(write_manifest(folder / "m.parquet", NAMES), folder / "out")
    return folder


@pytest.fixture
def out(made, tmp_path):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path / "out"


def test_a_complete_build_is_read_once(out, monkeypatch):
    following = BuildFollower(out)
    tally = following.read_tally()
    same_as_survey(out, tally)
    assert tally.stages == ("manifest", "look", "cut", "fall", "pack")
    assert tally.passed["look"] == 7
    monkeypatch.setattr(follow, "read_committed_shard", lambda *_, **__: pytest.fail("read again"))
    again = following.read_tally()
    assert (again.ended, again.passed, again.wall) == (tally.ended, tally.passed, tally.wall)


def test_every_step_of_a_build_is_seen(tmp_path, monkeypatch):
    manifest, out = write_manifest(tmp_path / "m.parquet", ["fine"] * 6), tmp_path / "out"
    build(write_manifest(tmp_path / "begun.parquet", ["fine"] * 6), out)
    for folder in ("scenes", "mjcf", "objects", "tasks", "timings"):
        for path in (out / folder).iterdir():
            path.unlink()
    rows = read_manifest(manifest)
    following, read = BuildFollower(out), []
    assert following.read_tally().accounted == 0
    real = follow.read_result
    monkeypatch.setattr(follow, "read_result", lambda path, entry: read.append(entry) or real(path, entry))
    ledger = Ledger(out, read_plan(out / "plan.parquet"))
    for number, row in enumerate(rows, start=1):
        call = ledger.record(number - 1, compute(row, out, shard=(number - 1) // 4))
        if call is not None:
            assert ledger.publish(call, stage_shard(out, call)) == []
        tally = following.read_tally()
        assert tally.accounted == number
        assert tally.committed == (number >= 4) + (number == 6)
        same_as_survey(out, tally)
    ledger.close()
    assert len(read) == 4, "each result of an open shard once; the last of a shard is read when it is committed"


def test_scenes_that_are_put_back_are_to_do_again(out):
    following = BuildFollower(out)
    before = following.read_tally()
    failed = [ending for ending in read_build_state(out).list_lost() if ending.status == "failed"]
    reopen_scenes(out, [ending.scene_id for ending in failed])
    tally = following.read_tally()
    assert tally.accounted == before.accounted - len(failed)
    assert tally.committed < before.committed
    same_as_survey(out, tally)
    build(out.parent / "m.parquet", out)
    after = following.read_tally()
    assert (after.ended, after.committed) == (before.ended, before.committed)


def test_a_torn_frame_is_not_there_yet_and_a_shorter_journal_is_read_anew(tmp_path):
    manifest, out = write_manifest(tmp_path / "m.parquet", ["fine"] * 4), tmp_path / "out"
    run_build(replace(request(manifest, out), limit=3), Silent())
    following, path = BuildFollower(out), journal_path(out, 0)
    whole = path.read_bytes()
    assert following.read_tally().accounted == 3
    path.write_bytes(whole[:-10])
    assert following.read_tally().accounted == 2
    path.write_bytes(whole)
    assert following.read_tally().accounted == 3


def test_a_running_build_is_followed_to_its_end(tmp_path):
    manifest, out = write_manifest(tmp_path / "m.parquet", ["slow_0.1"] * 14), tmp_path / "out"
    process = start(manifest, out)
    wait_until(lambda: (out / "run.json").exists())
    following, seen = BuildFollower(out), []
    while process.poll() is None:
        seen.append(following.read_tally().accounted)
        time.sleep(0.02)
    code, errors = finish(process)
    assert code == 0, errors
    assert seen == sorted(seen)
    assert len(set(seen)) > 3
    same_as_survey(out, following.read_tally())


def test_where_there_is_no_build_it_says_so(tmp_path):
    with pytest.raises(BuildError, match="holds no build"):
        BuildFollower(tmp_path)
