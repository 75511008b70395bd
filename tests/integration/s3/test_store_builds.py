"""A build into a store gives the bytes of a build on the disk, whatever is killed, fails or does not answer."""

import itertools
import random
import time
from dataclasses import replace

import pytest

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage import s3
from tableverse_factory.core.storage.files import get_store, list_names, parse_path
from tableverse_factory.dataset.journals import journal_path
from tableverse_factory.dataset.shard_plan import read_plan
from tests.helpers.builds import (
    Silent,
    build,
    compute,
    digests,
    finish,
    kill,
    request,
    start,
    wait_until,
    write_manifest,
)
from tests.helpers.store_contents import digests_in
from workers.plan.invalidate import reopen_scenes
from workers.plan.read_manifest import read_manifest
from workers.progress.build_state import read_build_state
from workers.progress.follow import BuildFollower
from workers.run import run_build
from workers.state import commit
from workers.state import ledger as ledger_module
from workers.state.journal import open_journal
from workers.state.ledger import Ledger
from workers.state.lock import create_writer_lock

NAMES = ["fine", "empty", "fine", "sad", "fine", "fell", "fine", "fine"]
WHOLE_TIMES = {"deadline_s": 60.0}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A manifest, and its build on the disk."""
    folder = tmp_path_factory.mktemp("whole")
    manifest = write_manifest(folder / "m.parquet", NAMES)
    build(manifest, folder / "out", **WHOLE_TIMES)
    return manifest, folder / "out"


def build_in(manifest, place, **run):
    """Builds into a store; the place is looked at anew, through the proxy where there is one."""
    out = parse_path(str(place))
    return run_build(replace(request(manifest, manifest.parent / "x", **{**WHOLE_TIMES, **run}), out=out), Silent())


def test_the_same_bytes_as_on_the_disk_also_with_the_manifest_in_the_store(whole, store):
    manifest, out = whole
    there = parse_path(f"{store}/m.parquet")
    get_store(there).pipe_file(there.path, manifest.read_bytes())
    asked = replace(request(manifest, out, **WHOLE_TIMES), manifest=there, out=store / "out")
    assert run_build(asked, Silent()).signal == 0
    assert digests_in(store / "out") == digests(out)
    assert not [name for name in get_store(store).list_sizes(store.path, recursive=True) if ".work" in name]
    found = read_build_state(store / "out")
    assert (found.done, found.dropped, found.failed, found.remaining) == (5, 2, 1, 0)
    assert BuildFollower(store / "out").read_tally().committed == found.shards == 2


@pytest.mark.slow  # tests/workers/test_run.py does it on the disk
def test_a_second_run_changes_nothing_and_another_build_is_refused(whole, store, proxy):
    manifest, _ = whole
    build_in(manifest, store)
    before = len(proxy.passed)
    build_in(manifest, store)
    written = {(p.method, p.path.partition("?")[0].rpartition("/")[2]) for p in proxy.passed[before:]}
    assert {name for method, name in written if method in ("PUT", "DELETE")} == {"lock"}
    with pytest.raises(BuildError, match=r"config\.run\.seed was 0 and is now 5"):
        build_in(manifest, store, seed=5)


def test_a_prefix_of_somebody_else_is_left_alone(whole, store):
    get_store(store).pipe_file((store / "thesis.tex").path, b"important")
    with pytest.raises(BuildError, match=r"holds thesis\.tex but no build"):
        build_in(whole[0], store)
    assert list_names(store) == ["thesis.tex"]


@pytest.mark.slow
def test_kill_minus_nine_at_random_moments_gives_the_same_bytes(store, tmp_path):
    manifest = write_manifest(tmp_path / "m.parquet", [*NAMES, *["slow_0.5"] * 5])
    build(manifest, tmp_path / "whole", **WHOLE_TIMES)
    rng, kills = random.Random(5), 0
    for number in range(3):
        process = start(manifest, store, **WHOLE_TIMES)
        wait_until(lambda: (store / ".work" / "lock").exists())
        time.sleep(rng.uniform(0.0, 2.0) + number)
        kills += process.poll() is None
        kill(process)
    assert kills >= 2, "a build that is done before it is killed proves nothing"
    code, errors = finish(start(manifest, store, **WHOLE_TIMES))
    assert code == 0, errors
    assert digests_in(store) == digests(tmp_path / "whole")


def test_a_second_driver_is_refused_by_name_while_the_first_lives(whole, store):
    with create_writer_lock(store / ".work" / "lock"), pytest.raises(BuildError, match="is being written by process"):
        build_in(whole[0], store)
    build_in(whole[0], store)


def test_a_driver_that_lost_its_lease_writes_nothing_more(whole, store, proxy, monkeypatch):
    """Its workers may still leave what stages gave, under names that say what it is."""
    manifest, out = whole
    checks, seen = itertools.count(), []

    def check(self):
        if next(checks) > 20:
            seen.append(len(proxy.passed))
            raise BuildError("lost")

    with monkeypatch.context() as patched:
        patched.setattr("workers.state.lease.Lease.check", check)
        with pytest.raises(BuildError, match="lost"):
            build_in(manifest, store)
    written = [p.path.partition("?")[0] for p in proxy.passed[seen[0] :] if p.method in ("PUT", "POST", "DELETE")]
    assert not [path for path in written if not path.endswith("/lock") and "/.stages/" not in path]
    build_in(manifest, store)
    assert digests_in(store) == digests(out)


EVERY_STEP = [step if step == 6 else pytest.param(step, marks=pytest.mark.slow) for step in range(14)]


@pytest.mark.parametrize("step", EVERY_STEP)
def test_a_kill_between_any_two_writes_of_a_commit_is_repaired(whole, store, monkeypatch, step):
    """As on the disk (see test_commit): reopens a scene and dies before the n-th write of its shard."""
    manifest, out = whole
    for name in (p.relative_to(out) for p in out.rglob("*") if p.is_file() and ".stages" not in p.parts):
        get_store(store).pipe_file((store / str(name)).path, (out / name).read_bytes())
    before = digests_in(store)
    rows, plan = read_manifest(manifest), read_plan(store / "plan.parquet")
    journal = open_journal(journal_path(store, 0))
    journal.reopen(rows[0].scene_id)
    journal.close()
    count = itertools.count()

    class Killed(BaseException):
        pass

    def until_killed(function):
        def do(*args):
            if next(count) == step:
                raise Killed
            function(*args)

        return do

    ledger = Ledger(store, plan)
    result = compute(rows[0], store)
    with monkeypatch.context() as patched:
        for name in ("write_atomic", "move", "remove", "remove_folder"):
            patched.setattr(commit, name, until_killed(getattr(commit, name)))
        patched.setattr(ledger_module, "remove_folder", until_killed(ledger_module.remove_folder))
        call = ledger.record(0, result)
        with pytest.raises(Killed):
            ledger.publish(call, commit.stage_shard(store, call))
        ledger.close()
    again = Ledger(store, plan)
    assert (again.todo(), again.committed) == ([], 2)
    again.close()
    assert list_names(store / ".work") == []
    assert digests_in(store) == before


@pytest.mark.slow  # test_commands.py does it on the disk, test_again_in_store.py begins again here
def test_retry_computes_the_failed_scene_alone(whole, store):
    manifest, out = whole
    build_in(manifest, store)
    failed = [ending.scene_id for ending in read_build_state(store).list_lost() if ending.status == "failed"]
    assert reopen_scenes(store, failed) == 1
    assert read_build_state(store).remaining == 1
    assert build_in(manifest, store).tally.before == len(NAMES) - 1
    assert digests_in(store) == digests(out)


@pytest.mark.slow  # a build under hundreds of faults; tests/core/storage has each kind
def test_errors_lost_answers_and_cut_bodies_now_and_then_change_nothing(whole, store, proxy):
    manifest, out = whole
    rng = random.Random(3)

    def fault(method, path):
        kinds = ["error", "lost", "refused"] + (["cut"] if method == "GET" else [])
        return rng.choice(kinds) if rng.random() < 0.08 else None

    proxy.fault = fault
    build_in(manifest, store)
    assert proxy.faults > 5
    proxy.fault = lambda method, path: None
    assert digests_in(store) == digests(out)


@pytest.mark.slow
def test_a_silent_store_is_asked_again(whole, store, proxy):
    manifest, out = whole
    silences = iter([True] * 3)
    proxy.fault = lambda method, path: "silent" if "scenes" in path and next(silences, False) else None
    build_in(manifest, store)
    assert proxy.faults == 3
    assert digests_in(store) == digests(out)


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        pytest.param("error", "the store answers (InternalError|500)", marks=pytest.mark.slow),
        pytest.param("refused", "the store does not answer", marks=pytest.mark.slow),
        pytest.param("silent", "the store does not answer", marks=pytest.mark.slow),
    ],
)
def test_a_store_that_fails_for_good_stops_the_build_and_the_same_command_goes_on(
    whole, store, proxy, monkeypatch, fault, why
):
    manifest, out = whole
    monkeypatch.setattr(s3, "_ATTEMPTS", 2)
    monkeypatch.setattr(s3.ObjectStore, "retries", 1)
    seen = itertools.count()
    proxy.silence_s = 1.5
    proxy.fault = lambda method, path: fault if "/scenes/" in path and method == "PUT" and next(seen) > 0 else None
    with pytest.raises(BuildError, match=rf"{store}.*{why}.*run the same command again") as stopped:
        build_in(manifest, store)
    assert "127.0.0.1" not in str(stopped.value) or "AWS_ENDPOINT_URL" in str(stopped.value)
    proxy.fault = lambda method, path: None
    assert read_build_state(parse_path(str(store))).committed == 1
    build_in(manifest, store)
    assert digests_in(store) == digests(out)
