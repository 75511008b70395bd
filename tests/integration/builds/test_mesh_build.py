"""Builds whose workers share a mesh process: it stays for all scenes, and ends when the last of them has gone."""

import json
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.helpers.builds import finish, kill, scenes, wait_until, write_manifest
from tests.helpers.paths import HELPERS, ROOT

RUN_BUILD = HELPERS / "run_build.py"
SERVER = HELPERS / "mesh_server.py"
IDLE_S = 20.0
"""In which nothing is left of a process that nobody asks any more [s]."""


@pytest.fixture
def log(tmp_path, monkeypatch):
    """What mesh processes were asked, each with the process's id."""
    path = tmp_path / "log"
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("PIPELINES_OF_TEST", "tests.helpers.mesh_pipeline:PIPELINES")
    return lambda: [line.rsplit(" ", 1) for line in path.read_text().splitlines()] if path.exists() else []


def building(
    folder: Path,
    names: list[str],
    behaviour: str,
    out: str = "out",
    *,
    shell: bool = False,
    workers: int = 1,
    silence_s: float = 120.0,
) -> subprocess.Popen[str]:
    """A build of these scenes, with this mesh process; below a shell that stays and a session of its own."""
    server = ["env", f"MESH_LOG={folder / 'log'}", sys.executable, str(SERVER), behaviour]
    line = ["setsid", "--wait", "sh", "-c", f"{shlex.join(server)}; true"] if shell else server
    manifest = folder / "images.parquet"
    if not manifest.exists():
        write_manifest(manifest, names)
    keys = {"place.mesh_model": "sam3d", "place.mesh_command": json.dumps(line), "run.memory_mb": 400}
    keys["place.mesh_timeout_s"] = silence_s
    overrides = [f"{key}={value}" for key, value in keys.items()]
    executor = ["local", "1"] if workers == 1 else ["ray", str(workers)]
    run = [sys.executable, str(RUN_BUILD), str(manifest), str(folder / out), *executor, *overrides]
    return subprocess.Popen(run, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True)


def asked_at(lines: list[list[str]], what: str) -> list[int]:
    return [int(pid) for words, pid in lines if words == what]


def is_gone(pid: int) -> bool:
    return not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


@pytest.mark.slow
def test_one_process_serves_all_workers_and_a_second_build_asks_nothing(tmp_path, log, monkeypatch):
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))  # for Ray's workers
    for out, made, workers in (("first", 6, 2), ("second", 0, 1)):
        before = len(log())
        code, errors = finish(building(tmp_path, [str(k) for k in range(6)], "well", out, workers=workers))
        assert code == 0, errors
        assert [row["status"] for row in scenes(tmp_path / out)] == ["done"] * 6
        asked = log()[before:]
        assert sum(words.startswith("make") for words, _ in asked) == made
    assert len({pid for _, pid in log()}) == 1, "the second build found the first one's process"
    wait_until(lambda: is_gone(int(log()[0][1])), IDLE_S)


@pytest.mark.slow
@pytest.mark.parametrize("shell", [False, True])
def test_it_outlives_a_worker_that_is_killed_and_ends_with_the_build(tmp_path, log, shell):
    build = building(tmp_path, ["1", "666"], "hang", shell=shell)
    wait_until(lambda: asked_at(log(), "make 666"))
    (process,) = asked_at(log(), "make 666")
    sandbox = next(
        child for child in psutil.Process(build.pid).children() if "workers.sandbox.child" in child.cmdline()
    )
    os.kill(sandbox.pid, signal.SIGKILL)
    wait_until(lambda: sandbox.pid not in [child.pid for child in psutil.Process(build.pid).children()])
    assert not is_gone(process)
    kill(build)
    wait_until(lambda: is_gone(process), IDLE_S)
    assert len(asked_at(log(), "start")) == 1


@pytest.mark.slow
def test_a_killed_build_asks_again_only_for_what_it_did_not_get(tmp_path, log):
    build = building(tmp_path, ["1", "666"], "hang once", silence_s=10.0)
    wait_until(lambda: asked_at(log(), "make 666"))
    kill(build)
    code, errors = finish(building(tmp_path, [], "hang once", silence_s=10.0))
    assert code == 0, errors
    assert len(asked_at(log(), "make 1")) == 1


@pytest.mark.slow
def test_a_process_that_does_not_start_stops_the_build_in_one_line(tmp_path, log):
    code, errors = finish(building(tmp_path, ["1", "2"], "no package"))
    assert code == 1
    last = errors.strip().splitlines()[-1]
    assert "does not start: it ended with exit code 1; it says: ModuleNotFoundError" in last
