"""The Slurm script for real, on a head of its own; only `srun` and `scontrol` are played, by a line of shell each."""

import os
import stat
import subprocess
import tempfile
from pathlib import Path

import psutil
import pytest

from tests.helpers.builds import build, digests, wait_until
from tests.helpers.clusters import BIN, clean_environment, end, tiny_tableverse, write_seen_manifest
from tests.helpers.paths import ROOT
from workers.progress.build_state import read_build_state

pytestmark = pytest.mark.slow

SCRIPT = ROOT / "deploy" / "slurm.sbatch"
NAMES = ["fine", "empty", *["slow_1.0"] * 14]
RUN = {"shard_size": 4, "deadline_s": 60.0, "memory_mb": 400}
SRUN = '#!/bin/sh\nwhile [ "${1#--}" != "$1" ]; do shift; done\nexec "$@"\n'
SCONTROL = '#!/bin/sh\nif [ "$1" = show ]; then echo "$3"; else echo "$@" >>"$REQUEUED"; fi\n'


def test_it_stops_before_the_limit_requeues_itself_and_goes_on_when_it_runs_again(tmp_path):
    manifest = write_seen_manifest(tmp_path / "images.parquet", NAMES)
    out = tmp_path / "out"
    first = start(tmp_path, manifest, out)
    try:
        wait_until(lambda: len(accounted(out)) >= 4 or first.poll() is not None, 120.0)
        first.terminate()
        said, _ = first.communicate(timeout=60.0)
    finally:
        end(first)
    assert first.returncode == 143, said
    assert (tmp_path / "requeued").read_text() == "requeue 4711\n", said
    assert "back into the queue" in said
    assert 4 <= len(accounted(out)) < len(NAMES)
    assert_nothing_is_left(tmp_path)

    second = start(tmp_path, manifest, out)
    try:
        said, _ = second.communicate(timeout=180.0)
    finally:
        end(second)
    assert second.returncode == 0, said
    assert (tmp_path / "requeued").read_text() == "requeue 4711\n", "a build that is complete is not requeued"
    build(manifest, tmp_path / "local", **RUN)
    assert digests(out) == digests(tmp_path / "local")
    assert_nothing_is_left(tmp_path)


def start(folder: Path, manifest: Path, out: Path) -> subprocess.Popen:
    """`sbatch deploy/slurm.sbatch manifest out …` on a node of this machine."""
    commands = tiny_tableverse(folder / "bin")
    for name, text in {"srun": SRUN, "scontrol": SCONTROL}.items():
        (commands / name).write_text(text)
        (commands / name).chmod(stat.S_IRWXU)
    environment = clean_environment(
        PATH=f"{commands}:{BIN}:{os.environ['PATH']}",
        PYTHONPATH=str(ROOT),
        HOME=str(folder),
        REQUEUED=str(folder / "requeued"),
        SLURM_JOB_ID="4711",
        SLURM_JOB_NODELIST="127.0.0.1",
        SLURM_CPUS_PER_TASK="2",
    )
    options = [f"--set=run.{key}={value}" for key, value in RUN.items()]
    return subprocess.Popen(
        ["bash", str(SCRIPT), str(manifest), str(out), *options],
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )


def assert_nothing_is_left(folder: Path) -> None:
    assert not (Path(tempfile.gettempdir()) / "ray-4711").exists()
    assert list(folder.glob(".tableverse-token*")) == []
    lines = [line for process in psutil.process_iter() if "ray-4711" in (line := command_line(process))]
    assert lines == []


def command_line(process: psutil.Process) -> str:
    try:
        return " ".join(process.cmdline())
    except psutil.Error:  # it ended while we looked
        return ""


def accounted(out: Path) -> set[str]:
    return set(read_build_state(out).scenes["scene_id"].to_pylist()) if (out / "run.json").exists() else set()
