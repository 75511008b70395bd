"""Places on the table: beside the reference, clear of everything."""

from collections import Counter

import numpy as np
from jaxtyping import Float64

from tableverse_factory.geometry.relations.relations import holds
from tableverse_factory.geometry.relations.stable_placement import CONTACT_M, stands
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.robotics.placements.clearance import least_gaps, outlines_clear
from tableverse_factory.robotics.placements.domains import Points2, Predicate
from tableverse_factory.robotics.placements.orientations import Turn
from tableverse_factory.robotics.placements.request import (
    ENOUGH,
    LOOKS,
    RELEASE_M,
    SAMPLES,
    NoPlacement,
    Place,
    PlacementRequest,
)
from tableverse_factory.robotics.placements.samples import Samples, joined

EDGE_M = 0.01
"""Least way from the object's box to the table's edge."""

_ROOMY_M = 0.06
"""More room than this around an object is no better."""

_PLAIN_M = 0.03
"""By so much one axis has to be the longer way to the reference that nobody doubts the side."""

_AXES = {Predicate.LEFT: 0, Predicate.RIGHT: 0, Predicate.FRONT: 1, Predicate.BACK: 1}

Metres = Float64[np.ndarray, " n"]
Corners = Float64[np.ndarray, "n 3"]


def beside(
    request: PlacementRequest, turns: tuple[Turn, ...], rng: np.random.Generator
) -> tuple[Place, ...] | NoPlacement:
    """Places on the table in the domain of the relation, best first; at most as many as are wanted."""
    upright = [turn for turn in turns if _stands(turn)]
    if not upright:
        return NoPlacement("does_not_stand", f"{request.x.object_id} as it lies now would not stand on the table")
    lost: Counter[str] = Counter()
    count = -(-SAMPLES * request.wanted // len(upright))
    samples = joined([_sampled(request, turn, index, count, lost, rng) for index, turn in enumerate(upright)])
    found: list[Place] = []
    for index in samples.order(request.avoided())[: LOOKS * request.wanted]:
        if len(found) == request.wanted or (len(found) >= ENOUGH and not samples.clear[index]):
            break
        place = _place(request, upright[samples.heading[index]], samples.cells[index], bool(samples.clear[index]), lost)
        found += [] if place is None else [place]
    told = ", ".join(f"{many} {why}" for why, many in lost.items() if many) or "none on the table"
    return tuple(found) or NoPlacement("no_room", f"of {count * len(upright)} samples {told}")


def _place(request: PlacementRequest, turn: Turn, cells: np.ndarray, clear: bool, lost: Counter[str]) -> Place | None:
    """The place, judged on shapes; None where it is none."""
    offset = np.array([*cells * request.cell, -request.lowest])
    stood = turn.body.moved((int(cells[0]), int(cells[1])), float(offset[2]))
    if not holds(request.relation, stood, request.y.body):
        lost["where the relation does not hold"] += 1
    elif not clear and not outlines_clear(stood, (*request.bodies, request.y.body), request.epsilon_m):
        lost[f"within {1e3 * request.epsilon_m:g} mm of something"] += 1
    else:
        return Place(turn, offset, (RELEASE_M,), "boxes" if clear else "outlines")
    return None


def _stands(turn: Turn) -> bool:
    body = turn.body
    return stands(body, body.heights.bottom <= body.low[2] + CONTACT_M)


def _sampled(
    request: PlacementRequest, turn: Turn, heading: int, count: int, lost: Counter[str], rng: np.random.Generator
) -> Samples:
    """Samples of one heading that stay on the table; `lost` counts the others."""
    cells, middles = request.cells(turn, count, rng)
    offset = np.column_stack([cells * request.cell, np.full(len(cells), -turn.body.low[2])])
    low, high = turn.body.low + offset, turn.body.high + offset
    edge = _edge_gaps(request.table, low, high)
    kept = edge >= EDGE_M
    lost["over the table's edge"] += int((~kept).sum())
    gap = least_gaps(low, high, (*request.bodies, request.y.body))[kept]
    costs = _costs(request, turn, middles[kept], np.minimum(gap, edge[kept]))
    return Samples(np.full(len(gap), heading), cells[kept], middles[kept], costs, gap >= request.epsilon_m)


def _edge_gaps(table: Slab, low: Corners, high: Corners) -> Metres:
    """Least way from each box to the table's edge [m]; negative where it reaches beyond."""
    c, s = np.cos(table.yaw), np.sin(table.yaw)
    along = np.array([[c, s], [-s, c]])
    middles = ((low + high)[:, :2] / 2 - table.center_xy) @ along.T
    halves = (high - low)[:, :2] / 2 @ np.abs(along).T
    gaps: Metres = (table.half_size_xy - np.abs(middles) - halves).min(axis=1)
    return gaps


def _costs(request: PlacementRequest, turn: Turn, middles: Points2, room: Metres) -> Metres:
    """What speaks against places: little room, a long way off, much turning, a side that one could doubt."""
    y = request.y.body
    apart = np.abs(middles - (y.low + y.high)[:2] / 2)
    half = np.maximum((y.high - y.low)[:2] / 2, 1e-3)
    far = np.linalg.norm(np.maximum(apart - half, 0.0), axis=1)
    costs: Metres = 1.0 - np.minimum(room, _ROOMY_M) / _ROOMY_M + far / 0.1 + 0.5 * turn.angle / np.pi
    if request.predicate in _AXES:
        axis = _AXES[request.predicate]
        longer = apart[:, axis] - apart[:, 1 - axis]
        costs = costs + 1.0 - np.clip(longer, 0.0, _PLAIN_M) / _PLAIN_M + 0.5 * apart[:, 1 - axis] / half[1 - axis]
    return costs
