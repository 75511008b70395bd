"""Twelve synthetic scenes, with motions: one set of bytes from every executor, cache and interruption."""

import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

from schemas.config import ObserveConfig
from tableverse_factory.sources.manifest import make_manifest, write_manifest
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures
from tests.helpers.builds import digests, finish, kill, scenes, wait_until
from workers.progress.build_state import read_build_state

N_SCENES = 12
LIMIT_S = 900.0

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The manifest, the cache that its build in one process filled, and the hashes of that build."""
    folder = tmp_path_factory.mktemp("twelve")
    synthesize_captures(folder / "captures", N_SCENES, seed=3)
    manifest = folder / "images.parquet"
    write_manifest(manifest, make_manifest([str(folder / "captures")], ObserveConfig()).rows)
    out, cache = folder / "local", folder / "cache"
    code, errors = finish(_start(manifest, out, cache, "local"), LIMIT_S)
    assert code == 0, errors
    assert sum(row["status"] == "done" for row in scenes(out)) >= N_SCENES - 2
    return manifest, cache, digests(out)


@pytest.mark.parametrize(("workers", "warm"), [(1, True), (2, False)])
def test_ray_gives_the_same_bytes_with_a_warm_or_a_cold_cache(whole, tmp_path, workers, warm):
    manifest, cache, expected = whole
    process = _start(manifest, tmp_path / "out", cache if warm else tmp_path / "cold", "ray", workers)
    code, errors = finish(process, LIMIT_S)
    assert code == 0, errors
    assert digests(tmp_path / "out") == expected


def test_three_kills_minus_nine_and_resume_give_the_same_bytes(whole, tmp_path):
    manifest, cache, expected = whole
    out, rng = tmp_path / "out", random.Random(20)
    for _ in range(3):
        before = _accounted(out)
        process = _start(manifest, out, cache, "ray", 2)
        wait_until(lambda before=before: _accounted(out) > before, LIMIT_S)
        time.sleep(rng.uniform(0.0, 3.0))
        assert process.poll() is None
        kill(process)
    code, errors = finish(_start(manifest, out, cache, "ray", 2), LIMIT_S)
    assert code == 0, errors
    assert digests(out) == expected


def _start(manifest: Path, out: Path, cache: Path, executor: str, workers: int = 1) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", "from tableverse_factory.cli.main import main; main()", "build"]
    options = ["--executor", executor, "--workers", str(workers), "--set", "run.shard_size=5"]
    options += ["--stages", "+trajectories", "--set", "trajectories.max_tasks=2"]
    environment = {**os.environ, "TABLEVERSE_CACHE": str(cache)}
    return subprocess.Popen(
        [*command, str(manifest), str(out), *options],
        text=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env=environment,
        start_new_session=True,
    )


def _accounted(out: Path) -> int:
    return read_build_state(out).scenes.num_rows if (out / "run.json").exists() else 0
