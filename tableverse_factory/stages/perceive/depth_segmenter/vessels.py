"""Vessels by their rims: outer wall, inner wall and floor are one object, which may contain others."""

import numpy as np
from jaxtyping import Float64
from scipy import ndimage

from schemas.geometry import IdImage, Mask, Vector3
from tableverse_factory.geometry.math.planes import Points2
from tableverse_factory.stages.perceive.base.object_filter import renumber_regions
from tableverse_factory.stages.perceive.base.table_view import TableView
from tableverse_factory.stages.perceive.depth_segmenter.containment import find_containers_by_outline
from tableverse_factory.stages.perceive.depth_segmenter.rims import BESIDE_M, Rim
from tableverse_factory.stages.perceive.depth_segmenter.surface import Surface

WALL_M = 0.006  # how far from its circle, its height, its lining or its floor a vessel's own pixel may be
LINING_STEP_M = 0.004  # height of the steps in which the inside of a wall is measured
OUTERMOST_PERCENT = 97.0  # percentile of a step's distances from the axis that is the wall
LEVEL_COS = 0.7  # between the normals of a floor and the table: up to 46 degrees
OWN_SHARE = 0.75  # least share of a region that is a vessel's from which it is one of its walls
MIN_WALL_PX = 12  # least pixels of a wall at the rim, of a step of its inside, and of a long object
# Least depth of a vessel that holds something, the larger of [m] and rim radii; the former if it has a handle
MIN_DEPTH_M, MIN_DEPTH = 0.02, 0.3

# What stands in a vessel: its foot is over the opening and inside it, or most of it is over the opening, or its axis
# points into it
FEET_M, FEET_PERCENT = 0.012, 15.0  # the foot: height over the lowest part, or percentile of heights if that is more
INNER_M = 0.002  # within the rim's circle
FEET_INSIDE, MOSTLY_OVER = 0.5, 0.75  # least shares of the foot and of the whole
# Most height over the rim of its lowest visible part; the latter if it points in
REACHES_IN_M, POINTS_IN_M = 0.025, 0.06
TOP_PERCENT, RISES_M = 97.0, 0.015  # percentile of heights that is a top; its least height over the rim if it rises

# Long objects, by the axis of their points
LONG = 3.0  # least ratio of the spread along the axis to that across it
BREADTHS = 4.0  # deviations across the axis that are the breadth
UPRIGHT_COS = 0.4  # between the axis and the vertical: what leans out has more, and a handle less
HANDLE_JOINT_M = 0.025  # most difference in height of a handle's beginning and the rim
HANDLE_BREADTH, HANDLE_MISS = 0.6, 0.3  # most breadth, and distance at which its axis passes the rim's, in rim radii

Distances = Float64[np.ndarray, "h w"]  # of the pixels of a rim's window [m]


def merge_vessel_walls(ids: IdImage, found: list[Rim], surface: Surface, view: TableView, least: int) -> IdImage:
    """Merge the regions of each vessel's wall, and split off contents that were merged with it.

    A vessel is round about the axis of its rim, so the place of a pixel tells the vessel's from its contents'
    (`_find_own_pixels`). A region is the vessel's if most of its pixels are and some are at the rim.
    """
    if not found:
        return ids
    result, xy = ids.copy(), view.xy(view.points_camera)
    level = surface.normals @ view.plane.normal > LEVEL_COS
    for rim in found:
        near, off = rim.window, rim.distance(xy[rim.window])
        own = _find_own_pixels(rim, off, level[near], view)
        _split_contents(result, near, own, rim.within[near] | (off < rim.radius), least)
        walls = _find_walls(result, rim, off, own, view)
        if walls and rim.height - rim.floor > MIN_DEPTH_M:
            others = [int(k) for k in np.unique(result[near]) if k > 0 and k not in walls]
            walls += [k for k in others if _is_handle(result == k, rim, xy, view)]
        if len(walls) > 1:
            result[np.isin(result, walls)] = walls[0]
    return renumber_regions(result, [int(k) for k in np.unique(result[result > 0])])


def _find_own_pixels(rim: Rim, off: Distances, level: Mask, view: TableView) -> Mask:
    """Find the vessel's pixels in the rim's window by their place: outside within its circle, inside its lining.

    `off` is the distance of the window's pixels from the rim's axis [m], `level` where their surface is level.
    """
    within, heights = rim.within[rim.window], view.heights[rim.window]
    beside = view.valid[rim.window] & (off < rim.radius + WALL_M) & (heights < rim.height + WALL_M)
    within_circle = (off < rim.radius - WALL_M) & (heights > rim.height - WALL_M)
    return (beside & ~within & ~within_circle) | _find_lining(rim, off, level, heights)


def _find_lining(rim: Rim, off: Distances, level: Mask, heights: Distances) -> Mask:
    """Find the visible inside of the vessel: its floor, and at each height what is as far out as its wall there."""
    within, steps = rim.within[rim.window], int(rim.height / LINING_STEP_M) + 1
    step = np.clip(heights / LINING_STEP_M, 0, steps).astype(np.int64)
    wall = np.zeros(steps + 1)
    for k in range(steps + 1):
        distances = off[within & (step == k)]
        if len(distances) >= MIN_WALL_PX:
            wall[k] = min(float(np.percentile(distances, OUTERMOST_PERCENT)), rim.radius)
    wall = np.maximum.accumulate(wall)
    floor = level & (heights < rim.floor + WALL_M)
    return within & (floor | (off > wall[step] - WALL_M))


def _split_contents(ids: IdImage, near: tuple[slice, slice], own: Mask, over: Mask, least: int) -> None:
    """Split large enough contents off regions that are also the vessel's, in place; masks are of the window `near`."""
    part_ids, largest = ids[near], int(ids.max(initial=0))
    vessel, content = (np.bincount(part_ids[mask], minlength=largest + 1) for mask in (own, ~own & over))
    for k in np.flatnonzero((vessel[1:] >= least) & (content[1:] >= least)) + 1:
        mask = (part_ids == k) & ~own
        parts, _ = ndimage.label(ndimage.binary_opening(mask & over, np.ones((3, 3)), iterations=2))
        for part in np.flatnonzero(np.bincount(parts.ravel())[1:] >= least) + 1:
            largest += 1
            part_ids[ndimage.binary_dilation(parts == part, iterations=2) & mask] = largest


def _find_walls(ids: IdImage, rim: Rim, off: Distances, own: Mask, view: TableView) -> list[int]:
    near, count = ids[rim.window], int(ids.max(initial=0)) + 1
    sizes = np.bincount(ids[view.valid], minlength=count)
    at_rim = own & (np.abs(view.heights[rim.window] - rim.height) < 2 * WALL_M) & (off > rim.radius - WALL_M)
    all_own, all_at_rim = (np.bincount(near[mask], minlength=count) for mask in (own, at_rim))
    parts = [k for k in range(1, count) if all_own[k] >= OWN_SHARE * sizes[k] > 0 and all_at_rim[k] >= MIN_WALL_PX]
    return sorted(parts, key=lambda k: -int(sizes[k]))


def add_insides(ids: IdImage, found: list[Rim], view: TableView) -> IdImage:
    """Add to each vessel the unassigned pixels inside its rim, its floor above all."""
    result, xy = ids.copy(), view.xy(view.points_camera)
    for rim in found:
        near, off = result[rim.window], rim.distance(xy[rim.window])
        near[rim.within[rim.window] & (near == 0) & (off < rim.radius + WALL_M)] = _find_vessel(result, rim, xy, view)
    return result


def find_containers(ids: IdImage, found: list[Rim], view: TableView) -> dict[int, int]:
    """Find the container of each region: round vessels by their rims, others, which contain no vessel, by outlines.

    No two regions contain each other: a vessel with a rim lies in none, and of two others the larger is the container.
    """
    round_ones = _find_vessels(ids, found, view)
    by_outline = find_containers_by_outline(ids, view).items()
    holders = {k: a for k, a in by_outline if k not in round_ones and a not in round_ones}
    return holders | _find_rim_contents(ids, found, round_ones, view)


def _find_rim_contents(ids: IdImage, found: list[Rim], vessels: list[int], view: TableView) -> dict[int, int]:
    """Find the vessel, of `_find_vessels`, of each region but vessels that stands in one or rises out of one.

    The lowest visible part decides: it is over the inside of the rim. Behind the vessel it is beyond the circle.
    """
    xy, holders = view.xy(view.points_camera), dict[int, int]()
    others = [k for k in range(1, int(ids.max(initial=0)) + 1) if k not in vessels]
    seen = {k: np.nonzero((ids == k) & view.valid) for k in others} if any(vessels) else {}
    for rim, vessel in zip(found, vessels, strict=True):
        if rim.height - rim.floor < max(MIN_DEPTH_M, MIN_DEPTH * rim.radius):
            continue
        for k, pixels in seen.items():
            if vessel and k not in holders and _stands_in(pixels, rim, xy, view):
                holders[k] = vessel
    return holders


def find_rising_contents(ids: IdImage, found: list[Rim], view: TableView) -> set[int]:
    """Find the regions that stand in a vessel and reach well above its rim, as no wall does."""
    vessels = _find_vessels(ids, found, view)
    rim_heights = {vessel: rim.height for rim, vessel in zip(found, vessels, strict=True)}
    holders = _find_rim_contents(ids, found, vessels, view)
    tops = {k: float(np.percentile(view.heights[(ids == k) & view.valid], TOP_PERCENT)) for k in holders}
    return {k for k, vessel in holders.items() if tops[k] > rim_heights[vessel] + RISES_M}


def _find_vessels(ids: IdImage, found: list[Rim], view: TableView) -> list[int]:
    """Find the id of each rim's vessel; 0 for none."""
    xy = view.xy(view.points_camera)
    return [_find_vessel(ids, rim, xy, view) for rim in found]


def _find_vessel(ids: IdImage, rim: Rim, xy: np.ndarray, view: TableView) -> int:
    """Find the id with most of the rim's pixels; 0 for none."""
    at_circle = np.abs(rim.distance(xy[rim.window]) - rim.radius) < WALL_M
    at_rim = at_circle & (np.abs(view.heights[rim.window] - rim.height) < WALL_M)
    near = ids[rim.window]
    shown = near[view.valid[rim.window] & at_rim & (near > 0)]
    return int(np.bincount(shown).argmax()) if len(shown) else 0


def _stands_in(seen: tuple[np.ndarray, ...], rim: Rim, xy: np.ndarray, view: TableView) -> bool:
    """Whether the visible part of a region begins in the rim's opening, lies mostly over it, or points into it."""
    if not len(seen[0]):
        return False
    heights = view.heights[seen]
    low = float(np.percentile(heights, 3)) - rim.height
    if low > REACHES_IN_M:
        return low < POINTS_IN_M and _points_in(xy[seen], heights, rim)
    feet = heights <= max(low + rim.height + FEET_M, float(np.percentile(heights, FEET_PERCENT)))
    over = rim.distance(xy[seen][feet]) < rim.radius - INNER_M
    through = rim.within[seen][feet] | (heights[feet] >= rim.height - WALL_M)
    if float((over & through).mean()) >= FEET_INSIDE:
        return True
    if low < -WALL_M:
        return False
    return float((rim.distance(xy[seen]) < rim.radius).mean()) >= MOSTLY_OVER or _points_in(xy[seen], heights, rim)


def _points_in(xy: Points2, heights: Float64[np.ndarray, " n"], rim: Rim) -> bool:
    """Whether a long object leans out of the rim: its axis, extended downwards, passes through the opening."""
    line = _fit_long_axis(xy, heights)
    if line is None or abs(line[1][2]) < UPRIGHT_COS:
        return False
    middle, axis, _ = line
    foot = middle + axis * (rim.height - middle[2]) / axis[2]
    return float(rim.distance(foot[:2])) < rim.radius - INNER_M


def _is_handle(mask: Mask, rim: Rim, xy: np.ndarray, view: TableView) -> bool:
    """Whether a region is a pan's handle: long, at the rim and pointing to its axis, nowhere near the table."""
    seen = mask & view.valid
    off, heights = rim.distance(xy[seen]), view.heights[seen]
    line = _fit_long_axis(xy[seen], heights)
    if line is None or abs(line[1][2]) > UPRIGHT_COS or float(np.percentile(heights, 5)) < rim.height / 2:
        return False
    middle, axis, breadth = line
    (x, y), (along_x, along_y) = middle[:2] - rim.center, axis[:2]
    misses = abs(x * along_y - y * along_x) / float(np.hypot(along_x, along_y))
    begins = float(np.percentile(off, 3))
    joint = float(np.median(heights[off < begins + 2 * WALL_M]))
    return (
        -WALL_M < begins - rim.radius < BESIDE_M
        and breadth < HANDLE_BREADTH * rim.radius
        and misses < HANDLE_MISS * rim.radius
        and abs(joint - rim.height) < HANDLE_JOINT_M
    )


def _fit_long_axis(xy: Points2, heights: Float64[np.ndarray, " n"]) -> tuple[Vector3, Vector3, float] | None:
    """Fit the middle, direction and approximate breadth of a long object; None for others."""
    if len(heights) < MIN_WALL_PX:
        return None
    points = np.column_stack([xy, heights])
    spread, axes = np.linalg.eigh(np.cov(points.T))
    if spread[2] <= LONG**2 * spread[1]:
        return None
    return points.mean(axis=0), axes[:, 2], BREADTHS * float(np.sqrt(max(spread[1], 0.0)))
