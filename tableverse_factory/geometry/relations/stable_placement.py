"""Stable placements: where a body, dropped from above, would stand in a relation to another (paper appendix C.2).

Candidates come from the paper's placement domains. Each is dropped onto the heights of the scene without the body and
counts if it lands stably, touches nothing beside it, and `relations.relation_holds`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float64
from scipy import ndimage

from schemas.curation import Relation
from schemas.geometry import Frozen, Vector3
from tableverse_factory.geometry.mesh.height_maps import CELL_M, LEVEL_TOLERANCE_M, CellMask, HeightMap, Heights
from tableverse_factory.geometry.relations.relations import SIDES, BodyFeatures, relation_holds

REACH_M = 0.4  # how far around the bodies the table is considered
CLEARANCE_M = 0.012  # free space around a body put down on the table: a finger's thickness
_DISTANCES_M = (0.02, 0.035, 0.05, 0.09, 0.15)
_SIDESTEPS = (0.0, -0.5, 0.5)
CONTACT_M = 0.002
_STAND_MARGIN_M = 0.002
_SUPPORT_SHARE = 0.7  # share of the base area that must be carried: a box on a lemon has less
_FLAT_SHARE = 0.6  # share of the area under a body that must be flat: scissors and balls carry nothing
_FITS_SHARE = 0.95
_SUBMERGED_SHARE = 0.25  # share of a body's height that must come to lie below the rim, or it topples out
_MAX_CANDIDATES = 49
_ANGLES = np.arange(16) * (2 * np.pi / 16)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
_INTO = (Relation.IN, Relation.INTO, Relation.INSIDE)
_AROUND = tuple(SIDES[side] for side in (Relation.RIGHT, Relation.LEFT, Relation.IN_FRONT, Relation.BEHIND))


@dataclass(frozen=True, slots=True, eq=False)
class SupportSurface(Frozen):
    """The bodies of a scene on their table; `free` is the bare table, 0 on it and +inf beyond its edge or reach."""

    bodies: tuple[BodyFeatures, ...]
    cell: float
    corner: tuple[int, int]
    free: Heights

    def without(self, index: int | None) -> Heights:
        """Heights of the table and of every body but one, or of all, on the cells of `free`."""
        heights = self.free.copy()
        for other, body in enumerate(self.bodies):
            if other == index:
                continue
            part = heights[self.window_of(body.heights)]
            np.maximum(part, body.heights.top, out=part)
        return heights

    def window_of(self, heights: HeightMap) -> tuple[slice, slice]:
        """Slices of `free` that a map covers."""
        i, j = heights.corner[0] - self.corner[0], heights.corner[1] - self.corner[1]
        return slice(i, i + heights.top.shape[0]), slice(j, j + heights.top.shape[1])


@dataclass(frozen=True, slots=True, eq=False)
class StablePose(Frozen):
    """The body as it would stand, and how it gets there from where it is, in the orientation that was tried [m]."""

    body: BodyFeatures
    offset: Vector3


class TableRectangle(Protocol):
    """A rectangle on z = 0: a table as it was seen, or a slab as it is exported."""

    @property
    def center_xy(self) -> Float64[np.ndarray, "2"]:
        """Its centre [m]."""

    @property
    def half_size_xy(self) -> Float64[np.ndarray, "2"]:
        """Half extents along its own axes [m]."""

    @property
    def yaw(self) -> float:
        """Rotation of its own axes about z [rad]."""


def make_support_surface(
    bodies: tuple[BodyFeatures, ...], table: TableRectangle, cell: float = CELL_M, reach_m: float = REACH_M
) -> SupportSurface:
    """Make the surface of a table with its bodies, `reach_m` around them."""
    low = np.min([body.low[:2] for body in bodies], axis=0) - reach_m
    high = np.max([body.high[:2] for body in bodies], axis=0) + reach_m
    first, last = np.floor(low / cell).astype(int), np.ceil(high / cell).astype(int)
    x, y = np.meshgrid(*((np.arange(first[k], last[k]) + 0.5) * cell for k in range(2)), indexing="ij")
    dx, dy = x - table.center_xy[0], y - table.center_xy[1]
    c, s = np.cos(table.yaw), np.sin(table.yaw)
    on_table = (np.abs(c * dx + s * dy) <= table.half_size_xy[0]) & (np.abs(c * dy - s * dx) <= table.half_size_xy[1])
    return SupportSurface(bodies, cell, (int(first[0]), int(first[1])), np.where(on_table, 0.0, np.inf))


def find_placement(
    relation: Relation,
    x: BodyFeatures,
    y: BodyFeatures,
    scene: SupportSurface,
    heights: Heights,
    poses: tuple[BodyFeatures, ...] = (),
) -> StablePose | None:
    """Find the first place where `x` would stand in this relation to `y`, or None.

    `heights` are `scene.without(index of x)`; `poses` are `x` in other orientations, to try after its own.
    """
    for body in (x, *poses):
        for target in _list_targets(relation, body, y):
            shift = np.rint((target - (body.low + body.high)[:2] / 2) / body.heights.cell).astype(int)
            moved = drop_body(relation, body, (int(shift[0]), int(shift[1])), y, scene, heights)
            if moved is not None and relation_holds(relation, moved, y):
                return StablePose(moved, moved.low - body.low)
    return None


def _list_targets(relation: Relation, x: BodyFeatures, y: BodyFeatures) -> Iterator[np.ndarray]:
    middle = (y.low + y.high)[:2] / 2
    if relation in _INTO:
        if y.cavity is not None:
            yield from _spread_candidates(y.cavity.cells, y.heights)
        return
    if relation is Relation.ON:
        if y.flat.any():
            yield from _spread_candidates(y.flat, y.heights)
        return
    half_x, half_y = ((body.high - body.low)[:2] / 2 for body in (x, y))
    for distance in _DISTANCES_M:
        for step in _SIDESTEPS:
            for axis, sign in (SIDES[relation],) if relation in SIDES else _AROUND:
                target = middle.copy()
                target[axis] += sign * (half_x[axis] + half_y[axis] + distance)
                target[1 - axis] += step * half_y[1 - axis]
                yield target


def _spread_candidates(cells: CellMask, heights: HeightMap) -> Iterator[np.ndarray]:
    """Generate at most `_MAX_CANDIDATES` cell centres, those deepest within the cells first."""
    depth = ndimage.distance_transform_edt(np.pad(cells, 1))[1:-1, 1:-1]
    stride = max(1, int(np.ceil(np.sqrt(cells.sum() / _MAX_CANDIDATES))))
    i, j = np.nonzero(cells)
    best = int(np.argmax(depth[i, j]))
    keep = ((i - i[best]) % stride == 0) & ((j - j[best]) % stride == 0)
    i, j = i[keep], j[keep]
    for k in np.argsort(-depth[i, j], kind="stable"):
        yield (np.array(heights.corner) + [i[k], j[k]] + 0.5) * heights.cell


def drop_body(
    relation: Relation,
    x: BodyFeatures,
    cells: tuple[int, int],
    y: BodyFeatures,
    scene: SupportSurface,
    heights: Heights,
) -> BodyFeatures | None:
    """Lower a body, moved by whole cells, until it touches `heights`, of the scene without it; None if not allowed."""
    here = x.heights.shifted(cells, 0.0)
    window = scene.window_of(here)
    if min(window[0].start, window[1].start) < 0 or window[0].stop > heights.shape[0]:
        return None
    ground = heights[window]
    if ground.shape != here.top.shape:
        return None
    filled = here.filled
    clearance = np.where(filled, here.bottom - np.where(filled, ground, 0.0), np.inf)
    least = float(clearance.min())
    if not np.isfinite(least):
        return None
    if relation in _INTO:
        return x.moved(cells, -least) if _fits_cavity(x, here, -least, y) else None
    touching = clearance <= least + CONTACT_M
    if not is_stable(x, touching):
        return None
    if relation is Relation.ON:
        allowed = _carries_flat(y, here, x.low[2] - least, ground, touching)
    else:
        allowed = _is_clear(window, filled, heights, scene)
    return x.moved(cells, -least) if allowed else None


def is_stable(x: BodyFeatures, touching: CellMask) -> bool:
    """Whether the centre is over the `touching` cells of the map, with a margin, and most of the base is carried."""
    base = x.heights.bottom <= x.low[2] + CONTACT_M
    if np.count_nonzero(touching & base) < _SUPPORT_SHARE * np.count_nonzero(base):
        return False
    contacts = (np.argwhere(touching) + np.array(x.heights.corner) + 0.5) * x.heights.cell
    reach = (contacts @ _DIRECTIONS).max(axis=0) + x.heights.cell / 2
    return bool((x.center[:2] @ _DIRECTIONS + _STAND_MARGIN_M <= reach).all())


def _fits_cavity(x: BodyFeatures, here: HeightMap, rise: float, y: BodyFeatures) -> bool:
    """Whether the whole body is over the opening, and enough of it below the rim."""
    if y.cavity is None:
        return False
    room = here.window(y.heights, y.cavity.opening, False)
    deep = y.cavity.rim_z - (x.low[2] + rise) >= _SUBMERGED_SHARE * (x.high[2] - x.low[2])
    return bool(deep) and int((here.filled & room).sum()) >= _FITS_SHARE * int(here.filled.sum())


def _carries_flat(y: BodyFeatures, here: HeightMap, level: float, ground: Heights, touching: CellMask) -> bool:
    """Whether the body touches `y` alone, and `y` is flat below it."""
    of_y = here.window(y.heights, y.heights.top, -np.inf)
    flat = here.filled & (np.abs(of_y - level) <= LEVEL_TOLERANCE_M)
    belongs = bool((of_y[touching] >= ground[touching] - CONTACT_M).all())
    return belongs and int(flat.sum()) >= _FLAT_SHARE * int(here.filled.sum())


def _is_clear(window: tuple[slice, slice], filled: CellMask, heights: Heights, scene: SupportSurface) -> bool:
    """Whether there is only bare table within `CLEARANCE_M`."""
    spare = int(np.ceil(CLEARANCE_M / scene.cell))
    (i0, i1), (j0, j1) = ((part.start, part.stop) for part in window)
    if min(i0, j0) < spare or i1 + spare > heights.shape[0] or j1 + spare > heights.shape[1]:
        return False
    around = heights[i0 - spare : i1 + spare, j0 - spare : j1 + spare]
    grown = ndimage.maximum_filter(np.pad(filled, spare), size=2 * spare + 1)
    return bool((around[grown] == 0.0).all())
