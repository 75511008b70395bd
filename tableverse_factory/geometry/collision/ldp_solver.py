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
Owners = Int64[np.ndarray, " m"]  # group of each constraint; -1 for those that never give way

INFEASIBLE_RESIDUAL = 1e-8  # residual of the dual below which no point satisfies all constraints (1 where none binds)
ITERATIONS_PER_UNKNOWN = 10  # A few are usual
MAX_ROUNDS = 30
VIOLATION_TOLERANCE = 1e-9  # constraints violated by more than this become active in the next round


class WorkLimitError(SolverError):
    """A problem costs more than is left of the work allowed; it was not started."""


class SolverEffort:
    """Budget of work for a sequence of problems; it is counted, not timed, so that results repeat."""

    def __init__(self, most: float = np.inf) -> None:
        self._left = float(most)

    def spend(self, work: float, what: str) -> None:
        """Charge a problem before it is solved; a refused one costs nothing, so that smaller ones may still follow."""
        if work > self._left:
            raise WorkLimitError(f"{what} are more than the work allowed")
        self._left -= work


def solve_least_motion(rows: Rows, bounds: Bounds) -> Values | None:
    """Find the shortest x with `rows @ x >= bounds`; None where there is none."""
    count = rows.shape[1]
    if not len(rows) or (bounds <= 0.0).all():
        return np.zeros(count)
    target = np.append(np.zeros(count), 1.0)
    try:
        dual, _ = nnls(np.vstack([rows.T, bounds]), target, maxiter=ITERATIONS_PER_UNKNOWN * (count + 1))
    except RuntimeError as error:  # scipy's: too many iterations
        raise SolverError(f"no least motion of {count} unknowns under {len(rows)} constraints: {error}") from error
    residual = np.concatenate([rows.T @ dual, [bounds @ dual - 1.0]])
    if -residual[count] < INFEASIBLE_RESIDUAL:
        return None
    return -residual[:count] / residual[count]


def _solve_least_violation(rows: Rows, bounds: Bounds, owners: Owners, softness: float) -> Values:
    """A short x where the constraints contradict one another: those of one owner give way together, at a price.

    Minimises `|x|² + |s / softness|²` under `rows @ x + s[owners] >= bounds`; s is 0 where the owner is -1.
    """
    count = rows.shape[1]
    named, column = np.unique(owners, return_inverse=True)
    give = softness * np.eye(len(named))[column] * (owners >= 0)[:, None]
    relaxed = solve_least_motion(np.hstack([rows, give]), bounds)
    if relaxed is None:
        raise SolverError(f"{int((owners < 0).sum())} constraints that never give way contradict one another")
    return relaxed[:count]


def solve_balanced_motion(
    rows: Rows,
    bounds: Bounds,
    owners: Owners,
    wishes: Rows,
    wished: Float64[np.ndarray, " k"],
    softness: float,
    effort: SolverEffort,
) -> Values:
    """Minimise `|x|² + |wishes @ x - wished|²` under `rows @ x >= bounds`.

    Contradicting constraints of one owner give way together, at a price; those of owner -1 never do. Constraints become
    active once they are violated: most never are. More work than the effort allows is a `SolverError`.
    """
    lower = np.linalg.cholesky(np.eye(rows.shape[1]) + wishes.T @ wishes)
    free = np.linalg.solve(lower.T, np.linalg.solve(lower, wishes.T @ wished))
    needed = bounds - rows @ free
    turned = np.linalg.solve(lower, rows.T).T
    motion, taken = np.zeros(rows.shape[1]), np.zeros(len(rows), dtype=bool)
    for _ in range(MAX_ROUNDS):
        violated = turned @ motion < needed - VIOLATION_TOLERANCE
        if not (violated & ~taken).any():
            return free + np.linalg.solve(lower.T, motion)
        taken |= violated
        motion = _solve_shortest(turned[taken], needed[taken], owners[taken], softness, effort)
    raise SolverError(f"constraints are still violated after {MAX_ROUNDS} rounds")


def _solve_shortest(rows: Rows, bounds: Bounds, owners: Owners, softness: float, effort: SolverEffort) -> Values:
    """Solve for the least motion, or where there is none for the least violation; costs are charged."""
    _spend(effort, *rows.shape)
    found = solve_least_motion(rows, bounds)
    if found is not None:
        return found
    _spend(effort, len(rows), rows.shape[1] + len(np.unique(owners)))
    return _solve_least_violation(rows, bounds, owners, softness)


def _spend(effort: SolverEffort, constraints: int, unknowns: int) -> None:
    """Charge constraints times unknowns squared, which the solver's time is about proportional to."""
    effort.spend(constraints * unknowns**2, f"{constraints} constraints on {unknowns} unknowns")
