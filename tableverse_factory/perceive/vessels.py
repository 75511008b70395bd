"""Vessels by their rims: wall seen from outside, wall seen from inside, and floor are one thing, and hold others."""

import numpy as np

from schemas.geometry import IdImage, Mask
from tableverse_factory.perceive.containment import containers
from tableverse_factory.perceive.joins import FLAT, bulge, described
from tableverse_factory.perceive.rims import Rim
from tableverse_factory.perceive.surface import Surface
from tableverse_factory.perceive.view import TableView

WALL_M = 0.006
OUTSIDE_SHARE = 0.7
INSIDE_SHARE = 0.85
WALL_SHARE = 0.3
MIN_WALL_PX = 12
MIN_DEPTH_M, MIN_DEPTH = 0.02, 0.3
REACHES_IN_M = 0.025
FEET_M = 0.012
INNER_M = 0.002
FEET_PERCENT = 15.0
FEET_INSIDE = 0.6


def whole_vessels(ids: IdImage, found: list[Rim], surface: Surface, view: TableView) -> IdImage:
    """The regions with those made one that are the wall of one vessel.

    Seen from outside, the wall is whatever lies below the rim, within its circle, but not seen through it. Seen from
    inside, it is what reaches the circle from within and does not bulge, as contents do.
    """
    result = ids.copy()
    if not found:
        return result
    xy = view.xy(view.points_camera)
    shapes = {k: bulge(region) for k, region in enumerate(described(ids, surface, view), start=1)}
    for rim in found:
        walls = _walls(result, rim, xy, view, shapes)
        if walls:
            result[np.isin(result, walls)] = walls[0]
    return result


def with_insides(ids: IdImage, found: list[Rim], view: TableView) -> IdImage:
    """The regions, and to each vessel what is seen inside its rim and belongs to nothing: its floor above all."""
    result, xy = ids.copy(), view.xy(view.points_camera)
    for rim in found:
        vessel = _vessel_of(result, rim, xy, view)
        result[rim.within & (result == 0) & (rim.distance(xy) < rim.radius + WALL_M)] = vessel
    return result


def _walls(ids: IdImage, rim: Rim, xy: np.ndarray, view: TableView, shapes: dict[int, float]) -> list[int]:
    """Ids of the vessel's parts, the largest first."""
    beside = view.valid & (rim.distance(xy) < rim.radius + WALL_M) & (view.heights < rim.height + WALL_M)
    outside = beside & ~rim.within
    count = int(ids.max(initial=0)) + 1
    sizes = np.bincount(ids[view.valid], minlength=count)
    at_rim = beside & (np.abs(view.heights - rim.height) < 2 * WALL_M) & (rim.distance(xy) > rim.radius - WALL_M)
    all_beside, all_outside, all_at_rim = (
        np.bincount(ids[mask], minlength=count) for mask in (beside, outside, at_rim)
    )
    parts = [
        k
        for k in range(1, count)
        if all_beside[k] >= INSIDE_SHARE * sizes[k] > 0
        and all_at_rim[k] >= MIN_WALL_PX
        and (all_outside[k] >= OUTSIDE_SHARE * sizes[k] or shapes.get(k, 1.0) <= FLAT)
    ]
    return sorted(parts, key=lambda k: -int(sizes[k]))


def what_holds(ids: IdImage, found: list[Rim], view: TableView) -> dict[int, int]:
    """What lies in what: in round vessels by their rims; in others, which no such vessel is in, by their outlines.

    So no two things lie in each other: a vessel with a rim lies in none, and of two others the larger holds.
    """
    round_ones = set(vessels_of(ids, found, view))
    by_outline = {k: a for k, a in containers(ids, view).items() if k not in round_ones and a not in round_ones}
    return by_outline | held_by_rims(ids, found, view)


def held_by_rims(ids: IdImage, found: list[Rim], view: TableView) -> dict[int, int]:
    """For each region that stands in a vessel or rises out of one, that vessel; a vessel itself lies in none.

    What counts is where the lowest part that is seen stands: over the inside of the rim. What hides behind the wall
    is lost to sight anywhere; what stands behind the vessel begins beyond the circle.
    """
    xy = view.xy(view.points_camera)
    vessels = vessels_of(ids, found, view)
    holders: dict[int, int] = {}
    for rim, vessel in zip(found, vessels, strict=True):
        if rim.height - rim.floor < max(MIN_DEPTH_M, MIN_DEPTH * rim.radius):
            continue
        for k in range(1, int(ids.max(initial=0)) + 1):
            if vessel and k not in vessels and k not in holders and _stands_in(ids == k, rim, xy, view):
                holders[k] = vessel
    return holders


def vessels_of(ids: IdImage, found: list[Rim], view: TableView) -> list[int]:
    """The id of each rim's vessel; 0 where none shows it."""
    xy = view.xy(view.points_camera)
    return [_vessel_of(ids, rim, xy, view) for rim in found]


def _vessel_of(ids: IdImage, rim: Rim, xy: np.ndarray, view: TableView) -> int:
    """The id that shows most of the rim; 0 for none."""
    near = np.abs(rim.distance(xy) - rim.radius) < WALL_M
    shown = ids[view.valid & near & (np.abs(view.heights - rim.height) < WALL_M) & (ids > 0)]
    return int(np.bincount(shown).argmax()) if len(shown) else 0


def _stands_in(mask: Mask, rim: Rim, xy: np.ndarray, view: TableView) -> bool:
    seen = mask & view.valid
    if not seen.any():
        return False
    heights = view.heights[seen]
    low = float(np.percentile(heights, 3))
    if low > rim.height + REACHES_IN_M:
        return False
    feet = heights <= max(low + FEET_M, float(np.percentile(heights, FEET_PERCENT)))
    over = rim.distance(xy[seen][feet]) < rim.radius - INNER_M
    through = rim.within[seen][feet] | (heights[feet] >= rim.height - WALL_M)
    return float((over & through).mean()) >= FEET_INSIDE
