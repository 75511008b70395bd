"""The least motion under linear constraints: least distance programming by non-negative least squares.

Lawson and Hanson, Solving Least Squares Problems, chapter 23: exact after finitely many steps, no tuning.
"""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.optimize import nnls

Rows = Float64[np.ndarray, "m n"]
Values = Float64[np.ndarray, " n"]
Bounds = Float64[np.ndarray, " m"]
Owners = Int64[np.ndarray, " m"]
"""Which constraints belong together; -1 for those that never give way."""

INFEASIBLE = 1e-8
"""Residual of the dual below which no point satisfies all constraints (1 where none binds)."""

ROUNDS = 30
VIOLATED = 1e-9
"""In a round the constraints violated by more than this are taken up."""


def least_motion(rows: Rows, bounds: Bounds) -> Values | None:
    """The shortest x with `rows @ x >= bounds`; None where there is none, or rounding keeps the solver from an end."""
    count = rows.shape[1]
    if not len(rows) or (bounds <= 0.0).all():
        return np.zeros(count)
    target = np.zeros(count + 1)
    target[count] = 1.0
    try:
        dual, _ = nnls(np.vstack([rows.T, bounds]), target, maxiter=30 * max(rows.shape))
    except RuntimeError:  # scipy's word for too many iterations
        return None
    residual = np.concatenate([rows.T @ dual, [bounds @ dual - 1.0]])
    if -residual[count] < INFEASIBLE:
        return None
    motion: Values = -residual[:count] / residual[count]
    return motion


def least_violation(rows: Rows, bounds: Bounds, owners: Owners, softness: float) -> Values:
    """A short x where the constraints contradict one another: those of one owner give way together, at a price.

    Minimises `|x|² + |s / softness|²` under `rows @ x + s[owners] >= bounds`; s is 0 where the owner is -1.
    """
    count = rows.shape[1]
    named, column = np.unique(owners, return_inverse=True)
    give = softness * np.eye(len(named))[column] * (owners >= 0)[:, None]
    relaxed = least_motion(np.hstack([rows, give]), bounds)
    return np.zeros(count) if relaxed is None else relaxed[:count]


def balanced_motion(
    rows: Rows, bounds: Bounds, owners: Owners, wishes: Rows, wished: Float64[np.ndarray, " k"], softness: float
) -> Values:
    """The x that minimises `|x|² + |wishes @ x - wished|²` under `rows @ x >= bounds`.

    Where the constraints contradict one another they give way as in `least_violation`. Constraints are taken up as
    they are violated: most never are.
    """
    lower = np.linalg.cholesky(np.eye(rows.shape[1]) + wishes.T @ wishes)
    free = np.linalg.solve(lower.T, np.linalg.solve(lower, wishes.T @ wished))
    needed = bounds - rows @ free
    turned = np.linalg.solve(lower, rows.T).T
    motion, taken = np.zeros(rows.shape[1]), np.zeros(len(rows), dtype=bool)
    for _ in range(ROUNDS):
        violated = turned @ motion < needed - VIOLATED
        if not (violated & ~taken).any():
            break
        taken |= violated
        found = least_motion(turned[taken], needed[taken])
        if found is None:
            found = least_violation(turned[taken], needed[taken], owners[taken], softness)
        motion = found
    answer: Values = free + np.linalg.solve(lower.T, motion)
    return answer
