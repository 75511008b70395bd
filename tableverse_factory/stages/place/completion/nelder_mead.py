"""Search for the least cost by Nelder and Mead (1965), which needs no gradient and forgives a rough cost."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize

Numbers = Float64[np.ndarray, " n"]


def minimize_cost(
    cost: Callable[[Numbers], float],
    start: Numbers,
    steps: Numbers,
    max_calls: int,
    *,
    xatol: float = 2e-4,
    fatol: float = 1e-6,
    adaptive: bool = False,
) -> Numbers:
    """Search from a simplex of the start and one step from it along each number; return the numbers of least cost.

    It ends when the simplex is no wider than `xatol` and its costs differ by no more than `fatol`, or after `max_calls`
    of the cost. `adaptive` fits the moves of the simplex to the count of numbers (Gao and Han, 2012).
    """
    options = {"initial_simplex": np.vstack([start, start + np.diag(steps)]), "maxfev": max_calls}
    options |= {"xatol": xatol, "fatol": fatol, "adaptive": adaptive}
    return np.asarray(minimize(cost, start, method="Nelder-Mead", options=options).x)
