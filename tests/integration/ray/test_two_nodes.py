"""Two nodes: one dies in the middle and nothing is lost; one that would give other rows, or none, is refused."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from tests.helpers.builds import build, digests, scenes, wait_until
from tests.helpers.clusters import (
    BIN,
    actors_below,
    clean_environment,
    end,
    ray_head,
    ray_node,
    tiny_tableverse,
    without,
    write_seen_manifest,
)
from tests.helpers.paths import HELPERS, ROOT
from workers.progress.build_state import read_build_state

pytestmark = pytest.mark.slow

LINE = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
NAMES = ["fine", "empty", *["slow_0.8"] * 30]
RUN = {"shard_size": 8, "deadline_s": 60.0, "memory_mb": 400}


def test_kill_minus_nine_of_the_raylet_of_the_second_node_loses_nothing(tmp_path):
    manifest = write_seen_manifest(tmp_path / "images.parquet", NAMES)
    build(manifest, tmp_path / "local", **RUN)
    out = tmp_path / "out"
    with two_nodes() as (address, raylet, keys):
        process = start_build(tmp_path, manifest, out, address, keys)
        try:
            wait_until(lambda: len(accounted(out)) >= 8, 120.0)
            assert actors_below(raylet), "the second node has no part in it"
            psutil.Process(raylet).kill()
            said, _ = process.communicate(timeout=240.0)
        finally:
            end(process)
    assert process.returncode == 0, said
    assert digests(out) == digests(tmp_path / "local")
    assert {row["attempts"] for row in scenes(out)} == {1}, "losing a node is no attempt of the scene"


def test_a_node_that_does_not_see_the_inputs_or_out_is_refused_before_any_work(tmp_path):
    manifest, out = write_seen_manifest(tmp_path / "images.parquet", ["fine"] * 3), tmp_path / "out"
    out.mkdir()
    with ray_head(1, PYTHONPATH=LINE) as head:
        environment = clean_environment(**head.environment, PYTHONPATH=LINE)
        for hidden, says in {"in": "does not see 3 of 3 inputs tried", "out": f"was written to {out}"}.items():
            node = ray_node(
                head.folder / hidden, [f"--address={head.address}"], 1, environment, without(tmp_path / hidden)
            )
            with node:
                process = start_build(tmp_path, manifest, out, head.address, head.environment)
                said, _ = process.communicate(timeout=120.0)
            assert process.returncode == 1, said
            assert says in said
            assert not list(out.glob("scenes/*"))


def test_a_node_that_joins_later_is_used_and_one_that_sees_less_stops_the_build(tmp_path):
    manifest, out = write_seen_manifest(tmp_path / "images.parquet", ["slow_0.8"] * 60), tmp_path / "out"
    with ray_head(1, PYTHONPATH=LINE) as head:
        environment = clean_environment(**head.environment, PYTHONPATH=LINE)
        process = start_build(tmp_path, manifest, out, head.address, head.environment)
        try:
            wait_until(lambda: process.poll() is not None or len(accounted(out)) >= 2, 120.0)
            assert process.poll() is None, process.communicate()[0]
            with ray_node(head.folder / "late", [f"--address={head.address}"], 1, environment) as node:
                wait_until(lambda: actors_below(node.pid), 120.0)
            said, _ = process.communicate(timeout=240.0)
        finally:
            end(process)
        assert process.returncode == 0, said
        process = start_build(tmp_path, manifest, tmp_path / "again", head.address, head.environment)
        try:
            wait_until(lambda: len(accounted(tmp_path / "again")) >= 2, 120.0)
            blind = without(tmp_path / "in")
            with ray_node(head.folder / "blind", [f"--address={head.address}"], 1, environment, blind):
                said, _ = process.communicate(timeout=240.0)
        finally:
            end(process)
        assert process.returncode == 1, said
        assert "does not see" in said


@contextmanager
def two_nodes() -> Iterator[tuple[str, int, dict[str, str]]]:
    """Address of the first, raylet of the second; two CPUs each."""
    with tempfile.TemporaryDirectory(prefix="tv-two-") as folder:
        keys = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "5c3a" * 16, "RAY_TMPDIR": folder}
        process = subprocess.Popen(
            [sys.executable, str(HELPERS / "run_cluster.py"), "2", f"{folder}/ray"],
            env=clean_environment(**keys, PYTHONPATH=LINE),
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        try:
            where = json.loads(process.stdout.readline())
            yield where["address"], where["raylet"], keys
        finally:
            end(process)


def start_build(folder: Path, manifest: Path, out: Path, address: str, keys: dict[str, str]) -> subprocess.Popen:
    commands = tiny_tableverse(folder / "bin")
    options = [f"--set=run.{key}={value}" for key, value in RUN.items()]
    return subprocess.Popen(
        [str(commands / "tableverse"), "build", str(manifest), str(out), "--address", address, *options],
        env=clean_environment(**keys, PYTHONPATH=LINE, PATH=f"{BIN}:{os.environ['PATH']}"),
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )


def accounted(out: Path) -> set[str]:
    return set(read_build_state(out).scenes["scene_id"].to_pylist()) if (out / "run.json").exists() else set()
