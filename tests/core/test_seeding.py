"""Randomness depends on seed, scene and stage alone, and streams are independent."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tableverse_factory.core.seeding import make_rng

names = st.text(max_size=30)


@pytest.mark.heavy
@given(st.integers(0, 2**63), names, names)
def test_the_same_three_give_the_same_numbers(seed, scene, stage):
    first = make_rng(seed, scene, stage).integers(0, 2**63, 4)
    np.testing.assert_array_equal(first, make_rng(seed, scene, stage).integers(0, 2**63, 4))


@given(st.tuples(st.integers(0, 9), names, names), st.tuples(st.integers(0, 9), names, names))
def test_other_three_give_other_numbers(a, b):
    same = np.array_equal(make_rng(*a).integers(0, 2**63, 4), make_rng(*b).integers(0, 2**63, 4))
    assert same == (a == b)


def test_scene_and_stage_do_not_run_together():
    assert make_rng(0, "ab", "c").integers(0, 2**63) != make_rng(0, "a", "bc").integers(0, 2**63)


@pytest.mark.heavy
def test_another_process_with_another_hash_seed_draws_the_same():
    """Python's own `hash` of a text changes with every process."""
    code = (
        "from tableverse_factory.core.seeding import make_rng; print(make_rng(7, 'scene', 'place').integers(0, 2**63))"
    )
    drawn = {
        subprocess.run([sys.executable, "-c", code], env={"PYTHONHASHSEED": h}, capture_output=True, check=True).stdout
        for h in ("1", "2")
    }
    assert drawn == {f"{make_rng(7, 'scene', 'place').integers(0, 2**63)}\n".encode()}


def test_streams_are_not_correlated():
    streams = np.stack([make_rng(0, f"scene_{i}", "place").normal(size=500) for i in range(40)])
    correlation = np.corrcoef(streams) - np.eye(40)
    assert np.abs(correlation).max() < 0.25  # 5.6 standard errors
