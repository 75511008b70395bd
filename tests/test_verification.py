"""`verify` on several processes."""

import json

import pytest
from learnable_dataset import write_learnable_dataset


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    out = write_learnable_dataset(tmp_path_factory.mktemp("verified") / "out", scenes=3)
    (out / "run.json").write_text(json.dumps({"config": {"trajectories": {"robot": "panda"}}}))
    return out


def test_any_number_of_processes_finds_the_same(dataset, run) -> None:
    alone = run("verify", dataset, "--trajectories", "--json", "--jobs", "1")
    both = run("verify", dataset, "--trajectories", "--json", "--jobs", "2")
    assert alone == both
    assert len(json.loads(alone[1])["scenes"]) == 3


def test_a_robot_that_is_none_is_said_before_any_scene(dataset, run) -> None:
    code, out, err = run("verify", dataset, "--trajectories", "--jobs", "2", "--robot", "nobody.xml")
    assert (code, out) == (1, "")
    assert "nobody.xml" in err
