"""`verify` on several processes."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import psutil
import pytest

from tableverse_factory.core.process_pool import count_available_cpus
from tableverse_factory.evaluation.verify import verify_scenes
from tests.helpers.learnable_dataset import write_learnable_dataset

pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    out = write_learnable_dataset(tmp_path_factory.mktemp("verified") / "out", scenes=5)
    (out / "run.json").write_text(json.dumps({"config": {"trajectories": {"robot": "panda"}}}))
    return out


def test_any_number_of_processes_finds_the_same(dataset, run) -> None:
    alone = run("verify", dataset, "--trajectories", "--json", "--jobs", "1")
    both = run("verify", dataset, "--trajectories", "--json", "--jobs", "2")
    assert alone == both
    assert len(json.loads(alone[1])["scenes"]) == 5


def test_scenes_that_are_not_built_yet_are_counted(tmp_path, run) -> None:
    out = write_learnable_dataset(tmp_path / "out", scenes=1)
    for known, rest, said in (({"scenes": 3}, 2, "; 2 scenes not built yet"), ({"scenes": "many"}, 0, ""), (7, 0, "")):
        (out / "run.json").write_text(json.dumps({"manifest": known}))
        assert json.loads(run("verify", out, "--json")[1])["not_built"] == rest
        assert run("verify", out)[1].endswith(f" of 1 scene verified{said}\n")


def test_a_robot_that_is_none_is_said_before_any_scene(dataset, run) -> None:
    code, out, err = run("verify", dataset, "--trajectories", "--jobs", "2", "--robot", "nobody.xml")
    assert (code, out) == (1, "")
    assert "nobody.xml" in err


def test_the_collisions_of_a_dataset_are_those_that_it_says(dataset, run) -> None:
    code, out, err = run("verify", dataset, "--epsilon", "0.01")
    assert (code, out) == (2, "")
    assert "--epsilon" in err


def test_what_was_built_again_is_opened_again(tmp_path) -> None:
    for scenes in (1, 2):
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        out = write_learnable_dataset(tmp_path / "out", scenes=scenes)
        found = list(verify_scenes(str(out), 1))
        assert [audit.scene_id for audit in found] == [f"s-{k}" for k in range(scenes)]
        assert all("drift_m" in audit.measured for audit in found), "a scene was not there"


@pytest.mark.slow  # verifies a dataset once more
def test_a_damaged_table_of_trajectories_costs_its_scenes_alone(dataset, tmp_path, run) -> None:
    out = shutil.copytree(dataset, tmp_path / "out")
    (out / "trajectories" / "shard-00001.parquet").write_bytes(b"PAR1 no more")
    _, said, _ = run("verify", out, "--json")
    measured = ["drift_m" in scene for scene in json.loads(said)["scenes"]]
    assert measured == [True, True, False, False, True]


@pytest.mark.parametrize("table", ["objects", "tasks", "scenes"])
def test_a_table_that_cannot_be_read_fails_the_dataset(dataset, tmp_path, run, table) -> None:
    out = shutil.copytree(dataset, tmp_path / "out")
    (out / table / "shard-00000.parquet").write_bytes(b"no parquet at all")
    code, _, err = run("verify", out)
    assert code == 1
    assert "shard-00000.parquet" in err
    assert "delete the file of that name in scenes/" in err


@pytest.mark.slow  # tests/cli/test_exit_codes.py stops commands
def test_a_stop_is_said_by_the_parent_alone(dataset) -> None:
    command = [sys.executable, "-c", "from tableverse_factory.cli.main import main; main()", "verify", str(dataset)]
    process = subprocess.Popen([*command, "--jobs", "2"], stderr=subprocess.PIPE, text=True, start_new_session=True)
    parent = psutil.Process(process.pid)
    while process.poll() is None and len(parent.children(recursive=True)) < 2:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert "Traceback" not in said
    found_bad = 1
    assert process.returncode in (130, found_bad), "stopped, or ended before the signal came"
    assert process.returncode == 130 or not said


def test_a_job_with_less_than_the_machine_starts_no_more_processes(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("tableverse_factory.core.process_pool.CGROUP_CPU_MAX", tmp_path / "cpu.max")
    everything = count_available_cpus()
    assert everything == len(os.sched_getaffinity(0))
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    assert count_available_cpus() == 1
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert count_available_cpus() == everything
