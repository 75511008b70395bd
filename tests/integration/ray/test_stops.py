"""Ctrl-C and SIGTERM at random moments of `tableverse build` on real stages: over within three seconds, and resumed."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from schemas.config import ObserveConfig
from tableverse_factory.sources.manifest import make_manifest, write_manifest
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures
from tests.helpers.builds import crowd, digests, finish, wait_until
from workers.progress.build_state import read_build_state

pytestmark = pytest.mark.slow

N_SCENES = 5
STOPS = 4
LIMIT_S = 600.0


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A manifest of real captures, the cache that its build filled, and the hashes of that build."""
    folder = tmp_path_factory.mktemp("stops")
    synthesize_captures(folder / "captures", N_SCENES, seed=11)
    manifest = folder / "images.parquet"
    write_manifest(manifest, make_manifest([str(folder / "captures")], ObserveConfig()).rows)
    code, errors = finish(_start(manifest, folder / "out", "local"), LIMIT_S)
    assert code == 0, errors
    return manifest, digests(folder / "out")


@pytest.mark.parametrize("executor", ["local", "ray"])
def test_whenever_it_is_asked_to_stop_it_stops_in_time_and_goes_on_later(whole, tmp_path, executor):
    manifest, expected = whole
    out, rng = tmp_path / "out", random.Random(executor)
    stopped = 0
    for turn in range(STOPS):
        process = _start(manifest, out, executor)
        if turn % 3:  # otherwise while it starts
            before = _accounted(out)
            wait_until(lambda p=process, n=before: p.poll() is not None or _accounted(out) > n, LIMIT_S)
        time.sleep(rng.uniform(0.5, 3.0))
        if process.poll() is not None:
            break
        asked, number = time.monotonic(), rng.choice([signal.SIGINT, signal.SIGTERM])
        if number == signal.SIGINT:
            os.killpg(process.pid, number)  # a terminal tells the whole group
        else:
            process.send_signal(number)
        code, _ = finish(process, LIMIT_S)
        assert time.monotonic() - asked < 3.0 * crowd()
        # While it starts, nothing listens for signals yet; then it must only end, not with success.
        assert code == 128 + number if turn % 3 else code != 0
        stopped += 1
    assert stopped >= STOPS // 2, "a build that is done before it is stopped proves nothing"
    code, errors = finish(_start(manifest, out, executor), LIMIT_S)
    assert code == 0, errors
    assert digests(out) == expected


def _start(manifest: Path, out: Path, executor: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", "from tableverse_factory.cli.main import main; main()", "build"]
    options = ["--executor", executor, "--set", "run.shard_size=2"]
    workers = ["--workers", "2"] if executor == "ray" else []
    return subprocess.Popen(
        [*command, str(manifest), str(out), *options, *workers],
        text=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env={**os.environ, "TABLEVERSE_CACHE": str(manifest.parent / "cache"), "OMP_NUM_THREADS": "1"},
        start_new_session=True,
    )


def _accounted(out: Path) -> int:
    return read_build_state(out).scenes.num_rows if (out / "run.json").exists() else 0
