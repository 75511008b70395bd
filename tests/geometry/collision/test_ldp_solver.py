"""The least motion under linear constraints, by what makes it the least (Karush, Kuhn, Tucker)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from tableverse_factory.core.errors import SolverError
from tableverse_factory.geometry.collision import ldp_solver as module
from tableverse_factory.geometry.collision.ldp_solver import (
    SolverEffort,
    WorkLimitError,
    solve_balanced_motion,
    solve_least_motion,
)


def solve_without_wishes(rows: np.ndarray, bounds: np.ndarray, owners: np.ndarray, softness: float) -> np.ndarray:
    none = np.zeros((0, rows.shape[1]))
    return solve_balanced_motion(rows, bounds, owners, none, np.zeros(0), softness, SolverEffort())


def problem(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random constraints that some point satisfies."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(int(rng.integers(1, 30)), int(rng.integers(1, 8))))
    return rows, rows @ rng.normal(0.0, 2.0, rows.shape[1]) - rng.uniform(0.0, 1.0, len(rows))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_the_answer_is_feasible_and_a_push_of_the_active_constraints(seed: int) -> None:
    rows, bounds = problem(seed)
    x = solve_least_motion(rows, bounds)
    assert x is not None
    assert (rows @ x >= bounds - 1e-7).all()
    active = rows[rows @ x <= bounds + 1e-6]
    assert nnls(active.T, x)[1] < 1e-6 if len(active) else np.abs(x).max() < 1e-9


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6))
def test_taking_constraints_up_as_they_are_violated_gives_the_same(seed: int) -> None:
    rows, bounds = problem(seed)
    lazy = solve_without_wishes(rows, bounds, np.full(len(rows), -1), 0.1)
    assert lazy == pytest.approx(solve_least_motion(rows, bounds), abs=1e-6)


def test_no_need_no_motion() -> None:
    assert solve_least_motion(np.array([[1.0, 0.0]]), np.array([-0.5])) == pytest.approx([0.0, 0.0])
    assert solve_least_motion(np.zeros((0, 2)), np.zeros(0)) == pytest.approx([0.0, 0.0])


def test_a_contradiction_has_no_answer_but_a_compromise() -> None:
    rows, bounds = np.array([[1.0], [-1.0]]), np.array([1.0, 1.0])
    assert solve_least_motion(rows, bounds) is None
    between = solve_without_wishes(rows, bounds, np.array([0, 1]), 0.1)
    assert between == pytest.approx([0.0], abs=1e-9)


def test_what_never_gives_way_wins() -> None:
    rows, bounds = np.array([[1.0], [-1.0]]), np.array([1.0, 1.0])
    assert solve_without_wishes(rows, bounds, np.array([-1, 0]), 1e-3) == pytest.approx([1.0], abs=1e-5)


def test_a_wish_pulls_as_far_as_its_weight() -> None:
    nothing = (np.zeros((0, 1)), np.zeros(0), np.zeros(0, dtype=np.int64))
    assert solve_balanced_motion(*nothing, np.array([[3.0]]), np.array([3.0]), 0.1, SolverEffort()) == pytest.approx(
        [0.9]
    )
    wall = (np.array([[-1.0]]), np.array([-0.5]), np.array([-1]))
    assert solve_balanced_motion(*wall, np.array([[3.0]]), np.array([3.0]), 0.1, SolverEffort()) == pytest.approx([0.5])


def test_what_never_gives_way_and_contradicts_itself_is_told() -> None:
    rows, bounds = np.array([[1.0], [-1.0]]), np.array([1.0, 1.0])
    never = np.array([-1, -1])
    with pytest.raises(SolverError, match="2 constraints that never give way"):
        solve_without_wishes(rows, bounds, never, 0.1)


def test_constraints_still_violated_when_the_rounds_are_over_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """The way out of the first constraint violates the second."""
    rows, bounds = np.array([[1.0, 0.0], [-1.0, 1.0]]), np.array([1.0, -0.5])
    free = (rows, bounds, np.array([-1, -1]), np.zeros((0, 2)), np.zeros(0), 0.1)
    assert solve_balanced_motion(*free, SolverEffort()) == pytest.approx([1.0, 0.5])
    monkeypatch.setattr(module, "MAX_ROUNDS", 1)
    with pytest.raises(SolverError, match="still violated after 1 rounds"):
        solve_balanced_motion(*free, SolverEffort())


def test_a_solver_without_an_end_is_not_a_contradiction(monkeypatch: pytest.MonkeyPatch) -> None:
    rows, bounds = problem(3)
    monkeypatch.setattr(module, "ITERATIONS_PER_UNKNOWN", -1)
    with pytest.raises(SolverError, match="no least motion"):
        solve_least_motion(rows, bounds)


def test_the_work_is_bounded_whatever_it_would_bring() -> None:
    rows, bounds = problem(3)
    none = np.zeros((0, rows.shape[1]))
    effort = SolverEffort(rows.shape[1] ** 2 / 2)
    with pytest.raises(WorkLimitError, match="more than the work allowed"):
        solve_balanced_motion(rows, bounds, np.full(len(rows), -1), none, np.zeros(0), 0.1, effort)


def test_what_is_refused_leaves_its_share_to_what_is_smaller() -> None:
    effort = SolverEffort(10.0)
    with pytest.raises(WorkLimitError):
        effort.spend(11.0, "things")
    effort.spend(6.0, "things")
    effort.spend(4.0, "things")
    with pytest.raises(WorkLimitError, match="things are more"):
        effort.spend(0.1, "things")
