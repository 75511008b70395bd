"""A kill at any step of a commit leaves a dataset that the next start completes, with the same bytes."""

import itertools
import os
import shutil
from pathlib import Path

import pytest

from tableverse_factory.core.errors import BuildError
from tableverse_factory.dataset.journals import WORK, journal_path
from tableverse_factory.dataset.shard_plan import make_plan, read_plan
from tableverse_factory.dataset.shards import FOLDERS, is_committed, shard_path
from tests.helpers.builds import build, compute, digests, write_manifest
from workers.plan.read_manifest import read_manifest
from workers.progress.build_state import read_build_state
from workers.state import checkpoint_store, commit
from workers.state import ledger as ledger_module
from workers.state.journal import open_journal
from workers.state.ledger import Ledger

pytestmark = pytest.mark.heavy

NAMES = ["fine", "empty", "fine", "fine"]


class _Killed(BaseException):
    """Stands for kill -9: nothing catches it."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a manifest and its dataset."""
    folder = tmp_path_factory.mktemp("made")
    build(write_manifest(folder / "m.parquet", NAMES), folder / "out")
    return folder


@pytest.fixture
def finished(made, tmp_path):
    """The same, to be damaged."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path / "m.parquet", tmp_path / "out"


STEPS = 15
"""The tar is written in one of its own, before the others: the one step that is not counted."""


@pytest.mark.parametrize("step", range(STEPS + 1))
def test_a_kill_between_any_two_files_is_repaired(finished, monkeypatch, step):
    """Reopens a scene and dies before the n-th thing that writing the shard anew does to the disk."""
    manifest, out = finished
    before = digests(out)
    plan = read_plan(out / "plan.parquet")
    result = _reopen_with_its_own_result(manifest, out)
    count = itertools.count()

    def until_killed(function):
        def do(*args):
            if next(count) == step:
                raise _Killed
            function(*args)

        return do

    ledger = Ledger(out, plan, keep=False)
    for name in ("write_atomic", "move", "remove", "remove_folder"):
        monkeypatch.setattr(commit, name, until_killed(getattr(commit, name)))
    for module in (ledger_module, checkpoint_store):
        monkeypatch.setattr(module, "remove_folder", until_killed(module.remove_folder))
    if step < STEPS:
        with pytest.raises(_Killed):
            _commit(ledger, out, result)
        scenes = shard_path(out, "scenes", 0)
        assert not scenes.exists() or shard_path(out, "mjcf", 0).exists()
    else:
        _commit(ledger, out, result)
        assert next(count) == STEPS
    monkeypatch.undo()
    ledger.close()
    again = Ledger(out, plan, keep=False)
    assert again.todo() == []
    assert again.committed == 1
    again.close()
    assert not [path for path in (out / checkpoint_store.CHECKPOINTS).rglob("*") if path.is_file()]
    shutil.rmtree(out / ".work")
    assert digests(out) == before


def test_the_scenes_file_is_there_only_when_all_others_are(finished, monkeypatch):
    manifest, out = finished
    plan = read_plan(out / "plan.parquet")
    result = _reopen_with_its_own_result(manifest, out)
    move, seen = commit.move, []

    def watch(source, target):
        move(source, target)
        seen.append((target.parent.name, is_committed(out, 0)))

    monkeypatch.setattr(commit, "move", watch)
    _commit(Ledger(out, plan), out, result)
    assert seen == [(folder, folder == "scenes") for folder in FOLDERS]


def test_a_shard_cut_short_after_its_commit_is_noticed(finished):
    manifest, out = finished
    plan = read_plan(out / "plan.parquet")
    result = _reopen_with_its_own_result(manifest, out)
    ledger = Ledger(out, plan)
    tar = shard_path(out, "mjcf", 0)
    tar.write_bytes(tar.read_bytes()[:2000])
    with pytest.raises(BuildError, match="too early"):
        _commit(ledger, out, result)


@pytest.mark.parametrize(
    ("folder", "merged"),
    [
        ("mjcf", False),
        ("objects", True),
        *(
            pytest.param(folder, merged, marks=pytest.mark.slow)
            for folder in FOLDERS
            for merged in (True, False)
            if folder != "scenes" and (folder, merged) not in (("mjcf", False), ("objects", True))
        ),
    ],
)
def test_a_file_that_a_committed_shard_has_lost_is_named_and_the_advice_mends_it(finished, folder, merged):
    manifest, out = finished
    before = digests(out)
    lost = shard_path(out, folder, 0)
    lost.unlink()
    if not merged:
        shutil.rmtree(out / "merged", ignore_errors=True)
    for look in (lambda: build(manifest, out), lambda: read_build_state(out)):
        with pytest.raises(BuildError, match=rf"{lost} is damaged .*delete scenes/shard-00000\.parquet, and the same"):
            look()
    shard_path(out, "scenes", 0).unlink()
    build(manifest, out)
    assert digests(out) == before


@pytest.mark.parametrize("length", [0, 2000, -10240, -1])
def test_a_tar_of_another_length_is_noticed_before_a_build_says_that_nothing_is_left(finished, length):
    manifest, out = finished
    tar = shard_path(out, "mjcf", 0)
    whole = tar.read_bytes()
    tar.write_bytes(whole[:length])
    with pytest.raises(BuildError, match=rf"{tar} is damaged \(\d+ bytes, not {len(whole)}\): delete scenes/"):
        build(manifest, out)


def _commit(ledger, out, result):
    """Records the result of the first scene, as the driver, and commits its shard, as a worker and the driver."""
    call = ledger.record(0, result)
    assert ledger.publish(call, commit.stage_shard(out, call)) == []


def _reopen_with_its_own_result(manifest, out):
    """Takes the first scene back and returns the result that it had."""
    row = read_manifest(manifest)[0]
    journal = open_journal(journal_path(out, 0))
    journal.reopen(row.scene_id)
    journal.close()
    return compute(row, out)


def test_the_journal_is_on_the_disk_before_a_worker_is_told_to_read_it(tmp_path, monkeypatch):
    """The worker may be on another machine, which sees through a network file system what was flushed."""
    (row,) = read_manifest(write_manifest(tmp_path / "m.parquet", ["fine"]))
    ledger = Ledger(tmp_path / "out", make_plan([row], 4))
    flushed: dict[Path, int] = {}
    fsync = os.fsync

    def note(descriptor):
        flushed[Path(f"/proc/self/fd/{descriptor}").readlink()] = os.fstat(descriptor).st_size
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", note)
    assert ledger.record(0, compute(row, tmp_path / "out")) is not None
    journal = journal_path(tmp_path / "out", 0)
    assert flushed[journal] == journal.stat().st_size
    ledger.close()


@pytest.mark.parametrize(
    "decision", ["", "ready\n", "ready\n../../../other\n", "ready\n/../../../other\n", "ready\nab\nwithout ../x\n"]
)
def test_a_decision_that_no_build_wrote_moves_and_removes_nothing(tmp_path, decision):
    """A dataset from elsewhere may name any folder in it."""
    other = tmp_path / "other.staging"
    other.mkdir()
    work = tmp_path / "its" / "out" / WORK
    (work / "shard-00000.").mkdir(parents=True)
    (work / "shard-00000.ready").write_text(decision)
    with pytest.raises(BuildError, match=r"shard-00000\.ready is damaged: delete it"):
        commit.publish_ready(work.parent)
    assert other.is_dir()
    (work / "shard-00000.ready").rename(work / "my.ready")
    commit.publish_ready(work.parent)
