"""`bench cameras` counts frames of every set of pictures, at the sizes that are asked for."""

import json

import pytest

from tests.helpers.recorded_dataset import two_scenes

pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return two_scenes(tmp_path_factory.mktemp("cameras") / "out")


@pytest.mark.slow  # figures of a bench
def test_every_set_is_measured_at_every_size(run, out):
    small = ("--size", "32x24", "--size", "16x16", "--episodes", 2, "--frames", 3)
    code, said, _ = run("bench", "cameras", out, *small, "--json")
    costs = json.loads(said)
    assert code == 0
    assert [(cost["width"], cost["height"]) for cost in costs] == [(32, 24)] * 4 + [(16, 16)] * 4
    assert all(cost["frames_per_s"] > 1 and cost["first_s"] > 0 and cost["episodes"] == 2 for cost in costs)
    alone, both = costs[0], costs[3]
    assert alone["frames_per_s"] > both["frames_per_s"], "six pictures take longer than one"
    code, said, _ = run("bench", "cameras", out, *small)
    assert code == 0
    assert "front and wrist, 32 × 24" in said


@pytest.mark.parametrize("size", ["128", "0x96", "128×96", "5000x96"])
def test_what_is_no_size_is_said(run, out, size):
    code, _, said = run("bench", "cameras", out, "--size", size)
    assert (code, "give width and height, e.g. 128x96" in said) == (1, True), said
