"""The least motion under linear constraints: least distance programming by non-negative least squares.

Lawson and Hanson, Solving Least Squares Problems, chapter 23: exact after finitely many steps, no tuning.
"""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.optimize import nnls

from tableverse_factory.core.errors import SolverError

Rows = Float64[np.ndarray, "m n"]
Values = Float64[np.ndarray, " n"]
Bounds = Float64[np.ndarray, " m"]
Owners = Int64[np.ndarray, " m"]
"""Which constraints belong together; -1 for those that never give way."""

INFEASIBLE = 1e-8
"""Residual of the dual below which no point satisfies all constraints (1 where none binds)."""

ITERATIONS = 10
"""The solver may take this many iterations for each unknown; a few are usual."""
ROUNDS = 30
VIOLATED = 1e-9
"""In a round the constraints violated by more than this are taken up."""


class TooMuchWorkError(SolverError):
    """A problem costs more than is left of the work allowed; it was not begun."""


class SolverEffort:
    """The work that a sequence of problems may cost; it is counted, not timed, so that the same work ends the same."""

    def __init__(self, most: float = np.inf) -> None:
        self._left = float(most)

    def spend(self, work: float, what: str) -> None:
        """Counts a problem before it is solved; what is refused costs nothing, so that smaller ones may still follow.

        Args:
            work: In the unit of what is allowed.
            what: The problem, for the message.

        Raises:
            TooMuchWorkError: if it costs more than is left.
        """
        if work > self._left:
            raise TooMuchWorkError(f"{what} are more than the work allowed")
        self._left -= work


def least_motion(rows: Rows, bounds: Bounds) -> Values | None:
    """The shortest x with `rows @ x >= bounds`; None where there is none.

    Raises:
        SolverError: if rounding keeps the solver from an end.
    """
    count = rows.shape[1]
    if not len(rows) or (bounds <= 0.0).all():
        return np.zeros(count)
    target = np.zeros(count + 1)
    target[count] = 1.0
    try:
        dual, _ = nnls(np.vstack([rows.T, bounds]), target, maxiter=ITERATIONS * (count + 1))
    except RuntimeError as error:  # scipy's word for too many iterations
        raise SolverError(f"no least motion of {count} unknowns under {len(rows)} constraints: {error}") from error
    residual = np.concatenate([rows.T @ dual, [bounds @ dual - 1.0]])
    if -residual[count] < INFEASIBLE:
        return None
    motion: Values = -residual[:count] / residual[count]
    return motion


def least_violation(rows: Rows, bounds: Bounds, owners: Owners, softness: float) -> Values:
    """A short x where the constraints contradict one another: those of one owner give way together, at a price.

    Minimises `|x|² + |s / softness|²` under `rows @ x + s[owners] >= bounds`; s is 0 where the owner is -1.

    Raises:
        SolverError: if those that never give way contradict one another, or the solver comes to no end.
    """
    count = rows.shape[1]
    named, column = np.unique(owners, return_inverse=True)
    give = softness * np.eye(len(named))[column] * (owners >= 0)[:, None]
    relaxed = least_motion(np.hstack([rows, give]), bounds)
    if relaxed is None:
        raise SolverError(f"{int((owners < 0).sum())} constraints that never give way contradict one another")
    return relaxed[:count]


def balanced_motion(
    rows: Rows,
    bounds: Bounds,
    owners: Owners,
    wishes: Rows,
    wished: Float64[np.ndarray, " k"],
    softness: float,
    effort: SolverEffort,
) -> Values:
    """The x that minimises `|x|² + |wishes @ x - wished|²` under `rows @ x >= bounds`.

    Where the constraints contradict one another they give way as in `least_violation`. Constraints are taken up as
    they are violated: most never are.

    Raises:
        SolverError: if it is more than the effort allows, or the solver comes to no end.
    """
    lower = np.linalg.cholesky(np.eye(rows.shape[1]) + wishes.T @ wishes)
    free = np.linalg.solve(lower.T, np.linalg.solve(lower, wishes.T @ wished))
    needed = bounds - rows @ free
    turned = np.linalg.solve(lower, rows.T).T
    motion, taken = np.zeros(rows.shape[1]), np.zeros(len(rows), dtype=bool)
    for _ in range(ROUNDS):
        violated = turned @ motion < needed - VIOLATED
        if not (violated & ~taken).any():
            answer: Values = free + np.linalg.solve(lower.T, motion)
            return answer
        taken |= violated
        motion = _shortest(turned[taken], needed[taken], owners[taken], softness, effort)
    raise SolverError(f"constraints are still violated after {ROUNDS} rounds")


def _shortest(rows: Rows, bounds: Bounds, owners: Owners, softness: float, effort: SolverEffort) -> Values:
    """The least motion, or where there is none the least violation; constraints times unknowns squared are counted."""
    _spend(effort, *rows.shape)
    found = least_motion(rows, bounds)
    if found is not None:
        return found
    _spend(effort, len(rows), rows.shape[1] + len(np.unique(owners)))
    return least_violation(rows, bounds, owners, softness)


def _spend(effort: SolverEffort, constraints: int, unknowns: int) -> None:
    """About what the solver's time goes with."""
    effort.spend(constraints * unknowns**2, f"{constraints} constraints on {unknowns} unknowns")
