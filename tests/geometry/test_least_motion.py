"""The least motion under linear constraints, by what makes it the least (Karush, Kuhn, Tucker)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from tableverse_factory.geometry.least_motion import balanced_motion, least_motion, least_violation


def problem(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random constraints that some point satisfies."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(int(rng.integers(1, 30)), int(rng.integers(1, 8))))
    return rows, rows @ rng.normal(0.0, 2.0, rows.shape[1]) - rng.uniform(0.0, 1.0, len(rows))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_the_answer_is_feasible_and_a_push_of_the_active_constraints(seed: int) -> None:
    rows, bounds = problem(seed)
    x = least_motion(rows, bounds)
    assert x is not None
    assert (rows @ x >= bounds - 1e-7).all()
    active = rows[rows @ x <= bounds + 1e-6]
    assert nnls(active.T, x)[1] < 1e-6 if len(active) else np.abs(x).max() < 1e-9


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_taking_constraints_up_as_they_are_violated_gives_the_same(seed: int) -> None:
    rows, bounds = problem(seed)
    none = np.zeros((0, rows.shape[1]))
    lazy = balanced_motion(rows, bounds, np.full(len(rows), -1), none, np.zeros(0), 0.1)
    assert lazy == pytest.approx(least_motion(rows, bounds), abs=1e-6)


def test_no_need_no_motion() -> None:
    assert least_motion(np.array([[1.0, 0.0]]), np.array([-0.5])) == pytest.approx([0.0, 0.0])
    assert least_motion(np.zeros((0, 2)), np.zeros(0)) == pytest.approx([0.0, 0.0])


def test_a_contradiction_has_no_answer_but_a_compromise() -> None:
    rows, bounds = np.array([[1.0], [-1.0]]), np.array([1.0, 1.0])
    assert least_motion(rows, bounds) is None
    between = least_violation(rows, bounds, np.array([0, 1]), 0.1)
    assert between == pytest.approx([0.0], abs=1e-9)


def test_what_never_gives_way_wins() -> None:
    rows, bounds = np.array([[1.0], [-1.0]]), np.array([1.0, 1.0])
    assert least_violation(rows, bounds, np.array([-1, 0]), 1e-3) == pytest.approx([1.0], abs=1e-5)


def test_a_wish_pulls_as_far_as_its_weight() -> None:
    nothing = (np.zeros((0, 1)), np.zeros(0), np.zeros(0, dtype=np.int64))
    assert balanced_motion(*nothing, np.array([[3.0]]), np.array([3.0]), 0.1) == pytest.approx([0.9])
    wall = (np.array([[-1.0]]), np.array([-0.5]), np.array([-1]))
    assert balanced_motion(*wall, np.array([[3.0]]), np.array([3.0]), 0.1) == pytest.approx([0.5])
