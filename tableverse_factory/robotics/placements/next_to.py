"""Placements on the table beside the reference, clear of everything."""

from collections import Counter

import numpy as np
from jaxtyping import Float64

from tableverse_factory.geometry.relations.relations import relation_holds
from tableverse_factory.geometry.relations.stable_placement import CONTACT_M, is_stable
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.robotics.placements.clearance import are_outlines_clear, compute_least_gaps
from tableverse_factory.robotics.placements.domains import SIDES, Points2
from tableverse_factory.robotics.placements.orientations import Orientation
from tableverse_factory.robotics.placements.request import (
    RELEASE_HEIGHT_M,
    SAMPLES_PER_PLACEMENT,
    CandidatePlacement,
    NoPlacement,
    PlacementRequest,
    PlacementSamples,
)

EDGE_CLEARANCE_M = 0.01  # minimum distance from the object's box to the table's edge
_FULL_CLEARANCE_M = 0.06  # clearance beyond which a placement is no better
_UNAMBIGUOUS_M = 0.03  # excess of one axis over the other that makes the side of the reference unambiguous
Metres = Float64[np.ndarray, " n"]
Corners = Float64[np.ndarray, "n 3"]


def find_places_beside(
    request: PlacementRequest, turns: tuple[Orientation, ...], rng: np.random.Generator
) -> tuple[CandidatePlacement, ...] | NoPlacement:
    """Find up to `request.wanted` placements in the relation's domain on the table, best first."""
    upright = [turn for turn in turns if is_stable(turn.body, turn.body.heights.bottom <= turn.body.low[2] + CONTACT_M)]
    if not upright:
        return NoPlacement("does_not_stand", f"{request.x.object_id} as it lies now would not stand on the table")
    lost: Counter[str] = Counter()
    count = -(-SAMPLES_PER_PLACEMENT * request.wanted // len(upright))
    parts = [_sample_heading(request, turn, index, count, lost, rng) for index, turn in enumerate(upright)]
    found = request.judge_samples(
        parts, lambda heading, cells, clear: _judge_place(request, upright[heading], cells, clear, lost)
    )
    told = ", ".join(f"{many} {why}" for why, many in lost.items() if many) or "none on the table"
    return tuple(found) or NoPlacement("no_room", f"of {count * len(upright)} samples {told}")


def _judge_place(
    request: PlacementRequest, turn: Orientation, cells: np.ndarray, clear: bool, lost: Counter[str]
) -> CandidatePlacement | None:
    """Check a sample on true shapes; count the reason of a rejection in `lost`."""
    offset = np.array([*cells * request.cell, -request.lowest])
    stood = turn.body.moved((int(cells[0]), int(cells[1])), float(offset[2]))
    if not relation_holds(request.relation, stood, request.y.body):
        lost["where the relation does not hold"] += 1
    elif not clear and not are_outlines_clear(stood, (*request.bodies, request.y.body), request.epsilon_m):
        lost[f"within {1e3 * request.epsilon_m:g} mm of something"] += 1
    else:
        return CandidatePlacement(turn, offset, (RELEASE_HEIGHT_M,), "boxes" if clear else "outlines")
    return None


def _sample_heading(
    request: PlacementRequest, turn: Orientation, heading: int, count: int, lost: Counter[str], rng: np.random.Generator
) -> PlacementSamples:
    """Sample one heading's placements that stay on the table; count the others in `lost`."""
    cells, middles = request.sample_cells(turn, count, rng)
    offset = np.column_stack([cells * request.cell, np.full(len(cells), -turn.body.low[2])])
    low, high = turn.body.low + offset, turn.body.high + offset
    edge = _compute_edge_gaps(request.table, low, high)
    kept = edge >= EDGE_CLEARANCE_M
    lost["over the table's edge"] += int((~kept).sum())
    gap = compute_least_gaps(low, high, (*request.bodies, request.y.body))[kept]
    costs = _compute_costs(request, turn, middles[kept], np.minimum(gap, edge[kept]))
    return PlacementSamples(np.full(len(gap), heading), cells[kept], middles[kept], costs, gap >= request.epsilon_m)


def _compute_edge_gaps(table: Slab, low: Corners, high: Corners) -> Metres:
    """Compute the distance from each box to the table's edge [m]; negative where it reaches beyond."""
    c, s = np.cos(table.yaw), np.sin(table.yaw)
    along = np.array([[c, s], [-s, c]])
    middles = ((low + high)[:, :2] / 2 - table.center_xy) @ along.T
    halves = (high - low)[:, :2] / 2 @ np.abs(along).T
    return (table.half_size_xy - np.abs(middles) - halves).min(axis=1)


def _compute_costs(request: PlacementRequest, turn: Orientation, middles: Points2, room: Metres) -> Metres:
    """Compute costs: little room, a long way, much turning, an ambiguous side."""
    y = request.y.body
    apart = np.abs(middles - (y.low + y.high)[:2] / 2)
    half = np.maximum((y.high - y.low)[:2] / 2, 1e-3)
    far = np.linalg.norm(np.maximum(apart - half, 0.0), axis=1)
    costs: Metres = 1.0 - np.minimum(room, _FULL_CLEARANCE_M) / _FULL_CLEARANCE_M + far / 0.1 + 0.5 * turn.angle / np.pi
    if len(sides := SIDES[request.relation]) == 1:
        axis = sides[0][0]
        longer = apart[:, axis] - apart[:, 1 - axis]
        costs = costs + 1.0 - np.clip(longer, 0.0, _UNAMBIGUOUS_M) / _UNAMBIGUOUS_M
        costs = costs + 0.5 * apart[:, 1 - axis] / half[1 - axis]
    return costs
