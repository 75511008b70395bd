"""Real Ray, real kill -9: the same bytes as one process gives, whoever dies on the way."""

import os
import random
import signal
import time
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from tableverse_factory.core.errors import BuildError
from tests.helpers.builds import (
    Silent,
    build,
    crowd,
    digests,
    finish,
    kill,
    request,
    scenes,
    start,
    wait_until,
    write_manifest,
)
from tests.helpers.paths import ROOT
from tests.helpers.processes import command_of, is_alive
from workers.progress.build_state import read_build_state
from workers.run import run_build

NAMES = ["fine", "empty", "fine", "segfault", "fine", "raise", "fell", "fine", "fine", "sad", *["slow_0.2"] * 6]
RUN = {"deadline_s": 60.0}
FULL_FOLDER = """
import sys, tempfile

def refuse(*_, **__):
    raise OSError(28, "No space left on device")

if any("default_worker.py" in word for word in sys.orig_argv):
    tempfile.TemporaryFile = refuse
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The manifest, and its build in one process."""
    folder = tmp_path_factory.mktemp("ray")
    manifest = write_manifest(folder / "images.parquet", NAMES)
    build(manifest, folder / "local", **RUN)
    return manifest, digests(folder / "local")


@pytest.mark.slow  # tests/integration/builds/test_poison.py compares them too, and the tests below after kills
@pytest.mark.parametrize("workers", [1, 2])
def test_ray_gives_the_same_bytes_as_one_process(whole, tmp_path, workers):
    manifest, expected = whole
    code, errors = finish(start(manifest, tmp_path / "out", "ray", workers, **RUN))
    assert code == 0, errors
    assert digests(tmp_path / "out") == expected


def test_kill_minus_nine_of_the_driver_and_then_of_actors_gives_the_same_bytes(whole, tmp_path):
    manifest, expected = whole
    out = tmp_path / "out"
    process = start(manifest, out, "ray", 2, **RUN)
    wait_until(lambda: any((out / ".work").glob("*.journal")))
    time.sleep(random.Random(5).uniform(0.0, 1.0))
    assert process.poll() is None
    workers = _workers(process.pid)
    kill(process)
    wait_until(lambda: not any(is_alive(worker) for worker in workers), 30.0)

    before = len(_accounted(out))
    process = start(manifest, out, "ray", 2, **RUN)
    wait_until(lambda: len(_accounted(out)) > before)
    for actor in _workers(process.pid, "ray::StageActor"):
        actor.kill()
    code, errors = finish(process)
    assert code == 0, errors
    assert digests(out) == expected
    assert {row["attempts"] for row in scenes(out) if row["error_kind"] != "crash"} == {1}


@pytest.mark.slow  # the test above kills actors; test_again_stopped.py counts runs
def test_a_stage_that_was_finished_before_its_actor_was_killed_is_not_run_again(tmp_path, monkeypatch):
    marks = tmp_path / "marks"
    marks.mkdir()
    monkeypatch.setenv("TINY_LINE_MARKS", str(marks))
    manifest = write_manifest(tmp_path / "m.parquet", ["slow_4", "fine"])
    process = start(manifest, tmp_path / "out", "ray", 1, **RUN)
    wait_until(lambda: (marks / "scene_000.cut").exists())
    for actor in _workers(process.pid, "ray::StageActor"):
        actor.kill()
    code, errors = finish(process)
    assert code == 0, errors
    runs = {path.name: path.stat().st_size for path in marks.iterdir()}
    assert runs["scene_000.look"] == 1
    assert runs["scene_000.cut"] == 2
    assert [row["attempts"] for row in scenes(tmp_path / "out")] == [1, 1]


def test_sigterm_stops_ray_within_three_seconds_and_nothing_computes_on(whole, tmp_path):
    manifest, _ = whole
    process = start(manifest, tmp_path / "out", "ray", 1, **RUN)
    wait_until(lambda: any((tmp_path / "out" / ".work").glob("*.journal")))
    workers = _workers(process.pid)
    assert workers
    process.send_signal(signal.SIGTERM)
    asked = time.monotonic()
    process.wait(timeout=60.0)
    assert time.monotonic() - asked < 3.0 * crowd()
    assert process.returncode == 143
    process.stderr.close()
    wait_until(lambda: not any(is_alive(worker) for worker in workers), 30.0)


def test_sigterm_while_ray_starts_is_a_stop_too(whole, tmp_path):
    manifest, _ = whole
    process = start(manifest, tmp_path / "out", "ray", 1, **RUN)
    driver = psutil.Process(process.pid)
    wait_until(lambda: any("gcs_server" in child.name() for child in driver.children()))
    process.send_signal(signal.SIGTERM)
    code, errors = finish(process)
    assert code == 143, errors


def test_actors_that_only_raise_stop_the_build_and_cost_no_scene(whole, tmp_path, monkeypatch):
    """No actor can start its sandbox, as where the temporary folder is full."""
    manifest, expected = whole
    (tmp_path / "sitecustomize.py").write_text(FULL_FOLDER)
    with monkeypatch.context() as patched:
        patched.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{ROOT}")
        code, errors = finish(start(manifest, tmp_path / "out", "ray", 2, **RUN))
    assert code == 1
    assert "6 workers raised errors in a row, the last one with: node " in " ".join(errors.split())
    assert "No space left on device" in errors
    assert not _accounted(tmp_path / "out")
    build(manifest, tmp_path / "out", **RUN)
    assert digests(tmp_path / "out") == expected


@pytest.mark.slow  # tests/workers/executors/test_ray_cluster.py refuses them without Ray
def test_more_workers_than_the_cluster_has_are_refused(whole, tmp_path):
    code, errors = finish(start(whole[0], tmp_path / "out", "ray", 10_000, **RUN))
    assert code != 0
    assert "10000 workers need 10000 CPUs" in errors


def test_a_cluster_that_is_not_there_is_a_clear_error(whole, tmp_path):
    asked = replace(request(whole[0], tmp_path / "out"), executor="ray", address="127.0.0.1:1")
    with pytest.raises(BuildError, match=r"Ray cluster at 127\.0\.0\.1:1 cannot be reached"):
        run_build(asked, Silent())


def _workers(driver: int, *kinds: str) -> list[psutil.Process]:
    """Processes below the driver that compute: actors, and the children of their sandboxes."""
    family = [(process, command_of(process)) for process in psutil.Process(driver).children(recursive=True)]
    return [
        p for p, line in family if any(kind in line for kind in kinds or ("ray::StageActor", "workers.sandbox.child"))
    ]


def _accounted(out: Path) -> set[str]:
    return set(read_build_state(out).scenes["scene_id"].to_pylist())
