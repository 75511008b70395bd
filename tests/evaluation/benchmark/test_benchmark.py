"""A benchmark file: the same bytes for the same dataset, and nothing believed that another wrote."""

import hashlib
import json

import numpy as np
import pytest

from tableverse_factory import open_dataset
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import MAX_JSON_BYTES
from tableverse_factory.evaluation.benchmark.benchmark import AXES, digest_scene, read_benchmark
from tableverse_factory.evaluation.benchmark.make import BenchmarkSettings, make_benchmark

pytestmark = pytest.mark.heavy


def test_the_same_dataset_gives_the_same_bytes_from_any_number_of_processes(out, benchmark):
    again = make_benchmark(open_dataset(out), BenchmarkSettings(perturbed=1), jobs=2)
    assert again.encode() == benchmark.encode()
    other = make_benchmark(open_dataset(out), BenchmarkSettings(perturbed=0, seed=1))
    assert {e.seed for e in other.episodes}.isdisjoint(e.seed for e in benchmark.episodes)


def test_a_file_is_read_back_whole(benchmark, tmp_path):
    path = tmp_path / "benchmark.json"
    path.write_bytes(benchmark.encode())
    read = read_benchmark(path)
    assert (read, read.digest) == (benchmark, hashlib.sha256(path.read_bytes()).hexdigest())


def test_episodes_hold_all_that_they_need(benchmark, dataset):
    for episode in benchmark.episodes:
        scene = dataset.scene(episode.scene_id)
        assert benchmark.scenes[episode.scene_id] == digest_scene(scene.files())
        row = next(row for row in scene.trajectory_rows() if row["task_id"] == episode.task.task_id)
        assert row["success"], "each is known to have a solution"
        assert np.allclose(episode.base.position, [row[f"base_{axis}_m"] for axis in "xyz"])
        assert episode.limit_steps >= 1.9 * row["duration_s"] * 50


def test_perturbed_episodes_repeat_unperturbed_ones_along_every_axis(benchmark):
    clean = {e.episode_id: e for e in benchmark.episodes if e.perturbation.axis == "none"}
    perturbed = [e for e in benchmark.episodes if e.perturbation.axis != "none"]
    assert [e.perturbation.axis for e in perturbed] == [axis for axis in AXES if axis != "none"]
    for episode in perturbed:
        own = clean[episode.episode_id.removesuffix(f"_{episode.perturbation.axis}")]
        assert (episode.seed, episode.task, episode.split) == (own.seed, own.task, "test")
        same_start = episode.start == own.start
        assert same_start == (episode.perturbation.axis != "start")


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"seed": -1}, "seed: Input should be greater than or equal to 0"),
        ({"robot": "../../arm.xml"}, "robot: String should match pattern"),
        ({"format": "tableverse-benchmark-9"}, "format: "),
        ({"scenes": {}}, "no digest of scene s-"),
        ({"scenes": {"s-0": "abc"}}, "scenes.s-0: String should match pattern"),
        ({"episodes": []}, "episodes: Tuple should have at least 1 item"),
        ({"extra": 1}, "extra: Extra inputs are not permitted"),
        ({"task": {"instruction": "a\u001b[2Jb"}}, r"text that cannot be printed"),
        ({"task": {"x_id": "../x"}}, r"task.x_id: .* is not usable"),
        ({"start": {"base": [0, 0, 0, 2, 0, 0, 0]}}, "its quaternion is not of unit length"),
        ({"start": {"base": [0, 0, float("nan"), 1, 0, 0, 0]}}, "start.base.2"),
        ({"limit_steps": 10**9}, "limit_steps: Input should be less than or equal to"),
        ({"perturbation": {"axis": "gravity"}}, "perturbation.axis"),
        ({"perturbation": {"friction": 1e9}}, "perturbation.friction"),
    ],
)
def test_what_is_no_benchmark_is_said(benchmark, tmp_path, change, problem):
    value = json.loads(benchmark.encode())
    episode = value["episodes"][0]
    for key, new in change.items():
        if isinstance(new, dict) and key in episode:
            episode[key] |= new
        elif key in episode and key != "seed":
            episode[key] = new
        else:
            value[key] = new
    path = tmp_path / "hostile.json"
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match=problem) as caught:
        read_benchmark(path)
    assert caught.value.reason == "bad_benchmark"
    assert "\n" not in str(caught.value)


def test_two_episodes_of_one_id_and_endless_files_are_refused(benchmark, tmp_path):
    value = json.loads(benchmark.encode())
    value["episodes"] *= 2
    path = tmp_path / "twice.json"
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match="two episodes have the same id"):
        read_benchmark(path)
    with path.open("wb") as file:
        file.truncate(MAX_JSON_BYTES + 1)
    with pytest.raises(InputError, match="is longer than"):
        read_benchmark(path)
    path.write_text("[" * 100_000)
    with pytest.raises(InputError, match="nested"):
        read_benchmark(path)
