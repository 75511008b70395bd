"""The search for the least cost finds the bottom of a bowl, and asks no more often than allowed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tableverse_factory.stages.place.completion.nelder_mead import minimize_cost


@pytest.mark.parametrize("adaptive", [False, True])
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_the_bottom_of_a_bowl_is_found(adaptive: bool, seed: int) -> None:
    bottom = np.random.default_rng(seed).uniform(-0.1, 0.1, 3)
    found = minimize_cost(
        lambda x: float(((x - bottom) ** 2).sum()), np.zeros(3), np.full(3, 0.05), 500, fatol=1e-9, adaptive=adaptive
    )
    np.testing.assert_allclose(found, bottom, atol=1e-3)


def test_the_first_simplex_is_the_start_and_a_step_along_each_number_and_calls_are_limited() -> None:
    asked: list[list[float]] = []

    def cost(x: np.ndarray) -> float:
        asked.append(x.tolist())
        return float(x @ x)

    minimize_cost(cost, np.array([1.0, 2.0]), np.array([0.5, -0.25]), 5)
    assert asked[:3] == [[1.0, 2.0], [1.5, 2.0], [1.0, 1.75]]
    assert len(asked) == 5
