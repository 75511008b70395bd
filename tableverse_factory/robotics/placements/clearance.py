"""Whether things keep clear of one another (paper, section 3.4).

The paper joins its two conditions, |Δx| ≥ b_x + b'_x + ε and |Δy| ≥ b_y + b'_y + ε, by *and*. Boxes are apart as soon
as one of them holds; taken at its word, the rule would forbid everything straight to the left of something, for there
Δy is 0. We ask for one of the two. Heights do not count, for what stands on the table has the whole column above it to
itself, hands come from there; but an object that is put on or into another may reach out over something lower by ε.

Boxes are wide around what lies aslant, and a crowded table then has no room at all. Where they leave too little, convex
outlines seen from above have to be ε apart instead; such places come last and say so (`Placement.clear_by`).
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from tableverse_factory.geometry.relations.relations import BodyFeatures, outline_gap

Corners = Float64[np.ndarray, "n 3"]


def box_gaps(
    low: Corners, high: Corners, others: Sequence[BodyFeatures], over_lower: bool = False
) -> Float64[np.ndarray, "n m"]:
    """Gap of each box to each body's box along the axis on which they are furthest apart; negative where they meet.

    Args:
        low: Lowest corners of the boxes. Shape (n, 3) [m].
        high: Highest corners. Shape (n, 3) [m].
        others: m bodies.
        over_lower: Whether a box that lies above a body counts as apart from it by the height between.
    """
    if not others:
        return np.zeros((len(low), 0))
    other_low, other_high = (np.stack([getattr(body, end) for body in others]) for end in ("low", "high"))
    apart = np.maximum(low[:, None] - other_high, other_low - high[:, None])
    gaps: Float64[np.ndarray, "n m"] = apart[..., :2].max(axis=2)
    if over_lower:
        gaps = np.maximum(gaps, low[:, None, 2] - other_high[:, 2])
    return gaps


def least_gaps(
    low: Corners, high: Corners, others: Sequence[BodyFeatures], over_lower: bool = False
) -> Float64[np.ndarray, " n"]:
    """Least gap of each box to any of the bodies [m]; infinite where there are none. Arguments as of `box_gaps`."""
    gaps = box_gaps(low, high, others, over_lower)
    least: Float64[np.ndarray, " n"] = gaps.min(axis=1, initial=np.inf)
    return least


def outlines_clear(
    body: BodyFeatures, others: Sequence[BodyFeatures], epsilon_m: float, over_lower: bool = False
) -> bool:
    """Whether a body is `epsilon_m` from each other by its box or, seen from above, by its convex outline."""
    gaps = box_gaps(body.low[None], body.high[None], others, over_lower)[0]
    near = [other for other, gap in zip(others, gaps, strict=True) if gap < epsilon_m]
    return all(outline_gap(body, other) >= max(epsilon_m, 1e-6) for other in near)
