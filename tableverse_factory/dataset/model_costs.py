"""Costs of a dataset's models, as its scenes record them: when each answer was first given, by any build."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from schemas.outcome import ModelCost
from tableverse_factory.core.text import pluralize

MODEL_ROLE_BY_STAGE = {"perceive": "detector", "curate": "judge"}  # of the model that it asks; prefixes columns
_FIGURES = ("calls", "input_tokens", "output_tokens", "usd")
COST_COLUMNS = tuple(f"{role}_{figure}" for role in MODEL_ROLE_BY_STAGE.values() for figure in _FIGURES)


def make_cost_columns(costs: Iterable[tuple[str, ModelCost]]) -> dict[str, Any]:
    """Make a scene's cost columns from the cost of each of its stages; null if no model was asked."""
    by_role = {MODEL_ROLE_BY_STAGE[stage]: cost for stage, cost in costs if stage in MODEL_ROLE_BY_STAGE}
    return {
        f"{role}_{figure}": getattr(by_role[role], figure) if role in by_role else None
        for role in MODEL_ROLE_BY_STAGE.values()
        for figure in _FIGURES
    }


def format_cost(cost: ModelCost) -> str:
    """Format a cost on one line, with money only if prices are known."""
    price = f", {cost.usd:.4g} USD" if cost.usd else ""
    return f"{pluralize(cost.calls, 'call')}, {cost.input_tokens} tokens read, {cost.output_tokens} written{price}"


def sum_model_costs(scenes: pa.Table) -> dict[str, ModelCost]:
    """Sum the costs of each role over rows of scenes/, without roles that asked nothing."""
    sums = {role: _sum_role(scenes, role) for role in MODEL_ROLE_BY_STAGE.values()}
    return {role: cost for role, cost in sums.items() if cost}


def _sum_role(scenes: pa.Table, role: str) -> ModelCost:
    calls, read, written = (pc.sum(scenes[f"{role}_{figure}"]).as_py() or 0 for figure in _FIGURES[:3])
    prices = scenes[f"{role}_usd"].drop_null().to_numpy()
    # one after the other, as they were added when each scene was an object: the same rounding
    return ModelCost(calls, read, written, float(np.add.accumulate(prices)[-1]) if len(prices) else 0.0)
