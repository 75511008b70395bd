"""A benchmark of synthetic scenes is built again from the seed, byte for byte, and its scenes are accepted."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

pytestmark = pytest.mark.slow

COMMANDS = """
synth {0}/captures --scenes 1 --seed 7
manifest {0}/captures --out {0}/images.parquet
build {0}/images.parquet {0}/out --executor local --stages +trajectories --set trajectories.max_tasks=1
benchmark make {0}/out --dest {0}/benchmark.json --jobs 1
"""


def run(command: str) -> None:
    code = "from tableverse_factory.cli.main import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *command.split()], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}: {done.stderr}"


def freeze(folder: Path) -> bytes:
    for command in COMMANDS.strip().splitlines():
        run(command.format(folder))
    return (folder / "benchmark.json").read_bytes()


def test_the_same_seed_gives_the_same_benchmark_whose_scenes_are_accepted(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    assert freeze(first) == freeze(second)
    out = tmp_path / "planner.jsonl"
    run(f"benchmark run {first}/benchmark.json --dataset {second}/out --policy planner --out {out} --jobs 1")
    assert out.read_bytes().count(b"\n") > 1
