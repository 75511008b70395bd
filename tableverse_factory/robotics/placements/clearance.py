"""Clearance between placed objects (paper, section 3.4).

The paper joins its conditions |Δx| ≥ b_x + b'_x + ε and |Δy| ≥ b_y + b'_y + ε by *and*, which would forbid everything
straight to the left of a reference, where Δy is 0; one of the two is required here. Heights do not count on the table,
where hands come from above; an object that is put on or into another may reach over a lower one by ε.

Where boxes leave no room, convex outlines seen from above have to be ε apart instead; such placements come last and are
marked (`Placement.clear_by`).
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from tableverse_factory.geometry.relations.relations import BodyFeatures, measure_outline_gap

Corners = Float64[np.ndarray, "n 3"]


def compute_box_gaps(
    low: Corners, high: Corners, others: Sequence[BodyFeatures], over_lower: bool = False
) -> Float64[np.ndarray, "n m"]:
    """Compute the gap of each box to each body's box along the axis of largest separation; negative where they overlap.

    With `over_lower`, a box above a body is separated from it by the height between. `low` and `high` are corners [m].
    """
    if not others:
        return np.zeros((len(low), 0))
    other_low, other_high = (np.stack([getattr(body, end) for body in others]) for end in ("low", "high"))
    apart = np.maximum(low[:, None] - other_high, other_low - high[:, None])
    gaps: Float64[np.ndarray, "n m"] = apart[..., :2].max(axis=2)
    if over_lower:
        gaps = np.maximum(gaps, low[:, None, 2] - other_high[:, 2])
    return gaps


def compute_least_gaps(
    low: Corners, high: Corners, others: Sequence[BodyFeatures], over_lower: bool = False
) -> Float64[np.ndarray, " n"]:
    """Compute the least gap of each box to any body [m], infinite without bodies; see `compute_box_gaps`."""
    return compute_box_gaps(low, high, others, over_lower).min(axis=1, initial=np.inf)


def are_outlines_clear(
    body: BodyFeatures, others: Sequence[BodyFeatures], epsilon_m: float, over_lower: bool = False
) -> bool:
    """Test whether a body is `epsilon_m` from every other by box or, seen from above, by convex outline."""
    gaps = compute_box_gaps(body.low[None], body.high[None], others, over_lower)[0]
    near = [other for other, gap in zip(others, gaps, strict=True) if gap < epsilon_m]
    return all(measure_outline_gap(body, other) >= max(epsilon_m, 1e-6) for other in near)
