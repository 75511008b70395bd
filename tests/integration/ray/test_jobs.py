"""Builds as jobs of a real head: submitted, stopped half-way, submitted again, complete; never without its token."""

import os
import subprocess
from pathlib import Path

import pytest

from tests.helpers.builds import build, digests, finish, scenes, wait_until
from tests.helpers.clusters import BIN, clean_environment, end, ray_head, tiny_tableverse, write_seen_manifest
from tests.helpers.paths import ROOT
from workers.progress.build_state import read_build_state

pytestmark = pytest.mark.slow

NAMES = ["fine", "empty", "fell", *["slow_1.2"] * 6] * 7
RUN = {"shard_size": 8, "deadline_s": 60.0, "memory_mb": 400}
OPTIONS = [f"--set=run.{key}={value}" for key, value in RUN.items()]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The manifest, and the hashes of its build in one process."""
    folder = tmp_path_factory.mktemp("jobs")
    manifest = write_seen_manifest(folder / "images.parquet", NAMES)
    build(manifest, folder / "local", **RUN)
    return manifest, digests(folder / "local")


@pytest.fixture(scope="module")
def head(tmp_path_factory):
    """A head whose `tableverse` runs the tiny line; everything else of the command line is the real one."""
    commands = tiny_tableverse(tmp_path_factory.mktemp("jobs") / "bin")
    with ray_head(2, PATH=f"{commands}:{BIN}:{os.environ['PATH']}", PYTHONPATH=str(ROOT)) as running:
        yield running


def test_a_job_stopped_half_way_and_submitted_again_completes_with_the_same_bytes(whole, head, tmp_path):
    manifest, expected = whole
    out = tmp_path / "out"
    code, said = submit(head, manifest, out, "--", *OPTIONS)
    assert code == 0, said
    job = said.split()[1]
    assert job.endswith("-out-1")
    wait_until(lambda: len(accounted(out)) >= 8, 120.0)
    ray(head, "job", "stop", job)
    assert 8 <= len(accounted(out)) < len(NAMES)

    code, said = submit(head, manifest, out, "--wait", "--", *OPTIONS)
    assert code == 0, said
    assert "-out-2" in said
    assert digests(out) == expected
    assert {row["attempts"] for row in scenes(out)} == {1}


def test_stop_ends_the_job_of_this_out_and_says_how_to_go_on(whole, head, tmp_path):
    manifest, _ = whole
    out = tmp_path / "out"
    follower = start_submit(head, manifest, out, "--wait", "--", *OPTIONS)
    try:
        wait_until(lambda: len(accounted(out)) >= 2, 120.0)
        code, said = submit(head, manifest, out, "--", *OPTIONS)
        assert code == 1
        assert f"{out} is being built by job tableverse-" in said
        code, said = submit(head, manifest, out, "--stop")
        assert code == 0, said
        assert "submit again to go on" in said
        assert finish(follower, 60.0)[0] == 143
    finally:
        end(follower)
    code, said = submit(head, manifest, out, "--stop")
    assert code == 1
    assert f"is building {out}" in said


def test_the_exit_code_and_the_log_of_the_build_come_back(head, tmp_path):
    manifest = write_seen_manifest(tmp_path / "images.parquet", ["fine", "raise"])
    code, said = submit(head, manifest, tmp_path / "out", "--wait", "--", *OPTIONS)
    assert code == 3, said
    assert "1 done, 0 dropped, 1 failed of 2 scenes" in said


def test_variables_travel_by_name_and_their_values_are_never_shown(whole, head, tmp_path):
    code, said = submit(head, whole[0], tmp_path / "out", "--wait", "--env", "TABLEVERSE_DEBUG", "--", "--set=a=b")
    assert code == 1
    assert "Traceback" in said, "the variable did not arrive"
    assert "hush-4711" not in said


def test_without_the_token_nothing_is_submitted(head, whole, tmp_path):
    for keys in ({}, {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64}):
        command = [str(BIN / "tableverse"), "submit", str(whole[0]), str(tmp_path / "out"), "--address", head.jobs]
        environment = clean_environment(HOME=str(tmp_path), **keys)
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert ended.returncode == 1
        assert "asks for a token" in ended.stderr
        assert "RAY_AUTH_TOKEN_PATH" in ended.stderr


def submit(head, manifest: Path, out: Path, *options: str) -> tuple[int, str]:
    process = start_submit(head, manifest, out, *options)
    said, errors = process.communicate(timeout=300.0)
    return process.returncode, said + errors


def start_submit(head, manifest: Path, out: Path, *options: str) -> subprocess.Popen:
    command = [str(BIN / "tableverse"), "submit", str(manifest), str(out), "--address", head.jobs, *options]
    environment = clean_environment(**head.environment, TABLEVERSE_DEBUG="hush-4711")
    return subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def ray(head, *words: str) -> str:
    command = [str(BIN / "ray"), *words, "--address", head.jobs]
    environment = clean_environment(**head.environment)
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=120.0).stdout


def accounted(out: Path) -> set[str]:
    return set(read_build_state(out).scenes["scene_id"].to_pylist()) if (out / "run.json").exists() else set()
