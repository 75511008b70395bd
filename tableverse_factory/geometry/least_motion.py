"""The least motion under linear constraints: least distance programming by non-negative least squares.

Lawson and Hanson, Solving Least Squares Problems, chapter 23: exact after finitely many steps, no tuning.
"""

import numpy as np
from jaxtyping import Float64
from scipy.optimize import nnls

Rows = Float64[np.ndarray, "m n"]
Values = Float64[np.ndarray, " n"]

INFEASIBLE = 1e-8
"""Residual of the dual below which no point satisfies all constraints (1 where none binds)."""


def least_motion(rows: Rows, bounds: Float64[np.ndarray, " m"]) -> Values | None:
    """The shortest x with `rows @ x >= bounds`; None where there is none."""
    count = rows.shape[1]
    if not len(rows) or (bounds <= 0.0).all():
        return np.zeros(count)
    target = np.zeros(count + 1)
    target[count] = 1.0
    dual, _ = nnls(np.vstack([rows.T, bounds]), target, maxiter=30 * max(rows.shape))
    residual = np.concatenate([rows.T @ dual, [bounds @ dual - 1.0]])
    if -residual[count] < INFEASIBLE:
        return None
    motion: Values = -residual[:count] / residual[count]
    return motion


def least_violation(rows: Rows, bounds: Float64[np.ndarray, " m"], softness: float) -> Values:
    """A short x where the constraints contradict one another: each may give way at a price.

    Minimises `|x|² + |s / softness|²` under `rows @ x + s >= bounds`.
    """
    count = rows.shape[1]
    relaxed = least_motion(np.hstack([rows, softness * np.eye(len(rows))]), bounds)
    return np.zeros(count) if relaxed is None else relaxed[:count]


def balanced_motion(
    rows: Rows, bounds: Float64[np.ndarray, " m"], wishes: Rows, wished: Float64[np.ndarray, " k"], softness: float
) -> Values:
    """The x that minimises `|x|² + |wishes @ x - wished|²` under `rows @ x >= bounds`.

    Where the constraints contradict one another each may give way at a price (`least_violation`).
    """
    lower = np.linalg.cholesky(np.eye(rows.shape[1]) + wishes.T @ wishes)
    free = np.linalg.solve(lower.T, np.linalg.solve(lower, wishes.T @ wished))
    turned = np.linalg.solve(lower, rows.T).T
    needed = bounds - rows @ free
    motion = least_motion(turned, needed)
    if motion is None:
        motion = least_violation(turned, needed, softness)
    answer: Values = free + np.linalg.solve(lower.T, motion)
    return answer
