"""Round rims of open vessels: level circles over which the picture shows a hollow, and never looks through a wall.

The near wall of a bowl is seen from outside and its far wall from inside, so that contents may separate them in the
picture. They share the rim: one circle at one height.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, IdImage, Mask
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.geometry.math.camera import project
from tableverse_factory.geometry.math.planes import Points2
from tableverse_factory.stages.perceive.base.table_view import TableView, compute_depth_noise, expand_window

UPWARDS_PX = 2  # a pixel is of an upper contour if its region has ended so many rows above
# Pixels of an upper contour: with fewer no circle is looked for; of more, from so many to twice as many are used
MIN_CONTOUR_PX, CONTOUR_SAMPLES = 16, 250
TRIES = 160  # circles through three of them
MIN_TRIANGLE_M2 = 1e-5  # four times the area of three points: smaller ones are in line
# Most distance of a rim's points from its circle, along the table and in height: the larger of [m] and deviations of
# the sensor's noise
TOLERANCE_M, NOISES = 0.004, 2.5
REFINEMENTS = 3  # least-squares fits of the circle, each to the points near the last one
MIN_RADIUS_M, MAX_RADIUS_M = 0.025, 0.17  # of a rim
MIN_RIM_M = 0.012  # least height of a rim over the table
MIN_OWN = 0.35  # least share of a region's upper contour that is on the circle found from it
RIM_SECTORS, MIN_RIM_SECTORS = 36, 9  # directions around a rim, and in how many of them it must be visible
MIN_CAMERA_RISE = 0.25  # least height of the camera over a rim, in radii of the rim
OPENING = 0.92  # radius of the opening, in radii of the rim

# What is seen through the opening: a hollow, no lid, and nothing beyond the walls
HOLLOW_M = 0.008  # below the rim from which it is in the hollow; what is nearer to the rim's height is level with it
MIN_HOLLOW_SHARE, MIN_HOLLOW_PX = 0.08, 60  # least share of the opening's pixels in the hollow, and least number
MAX_LEVEL = 0.5  # most share of the opening's pixels that is level with the rim: more are a lid
THROUGH_M = 0.012  # distance beyond the wall from which something was seen through it
MAX_THROUGH = 0.04  # most share of the opening's pixels that show what is beyond the wall
MAX_MISSING = 0.15  # most share of the circle where only what is behind it is seen, so that no wall is there
BESIDE_PX = 2  # around a point of the circle where its wall is looked for; the margin of a rim's window
BESIDE_M = 0.025  # outside the circle: so far reaches a rim's window, and so far away a handle may begin

Circle = tuple[float, float, float, float]  # x, y, radius and height [m]


@dataclass(frozen=True, slots=True, eq=False)
class Rim(Frozen):
    """A level circle over the table, in the coordinates of `TableView.xy` [m]."""

    center: Float64[np.ndarray, "2"]
    radius: float
    height: float
    floor: float  # 5th percentile of the heights inside [m]
    sectors: int  # number of the `RIM_SECTORS` directions in which it is visible
    within: Mask  # pixels seen through its disc, below its height
    window: tuple[slice, slice]  # with all of `within`, all nearer than `BESIDE_M` to its disc, and `BESIDE_PX` around

    def distance(self, xy: Float64[np.ndarray, "*shape 2"]) -> Float64[np.ndarray, "*shape"]:
        """Compute the distance from its axis [m]."""
        return _compute_length(xy[..., 0] - self.center[0], xy[..., 1] - self.center[1])


def find_rims(ids: IdImage, view: TableView) -> list[Rim]:
    """Find the rims along the upper contours of the regions, the most complete first, without duplicates."""
    contour = _find_upper_contour(ids, view.valid)
    rows, columns = np.nonzero(contour)
    if len(rows) < MIN_CONTOUR_PX:
        return []
    points = view.points_camera[rows, columns]
    owner, xy, heights = ids[rows, columns], view.xy(points), view.heights[rows, columns]
    tolerance = max(TOLERANCE_M, NOISES * float(compute_depth_noise(np.median(points[:, 2]))))
    table_xy = view.xy(view.points_camera)
    found = []
    for k in range(1, int(ids.max(initial=0)) + 1):
        own = np.flatnonzero(owner == k)
        own = own[:: max(1, len(own) // CONTOUR_SAMPLES)]
        circle = _find_circle(xy[own], heights[own], tolerance) if len(own) >= MIN_CONTOUR_PX else None
        for _ in range(REFINEMENTS):
            circle = None if circle is None else _refine_circle(circle, xy, heights, tolerance)
        if circle is None or float(_is_on_circle(circle, xy[own], heights[own], tolerance).mean()) < MIN_OWN:
            continue
        rim = _validate_rim(circle, xy[_is_on_circle(circle, xy, heights, tolerance)], table_xy, view)
        if rim is not None:
            found.append(rim)
    return _drop_duplicates(found)


def _find_upper_contour(ids: IdImage, valid: Mask) -> Mask:
    """Find the pixels of regions with another region or none above them in the picture."""
    above = np.zeros_like(ids)
    above[UPWARDS_PX:] = ids[:-UPWARDS_PX]
    contour: Mask = (ids > 0) & (above != ids) & valid
    contour[:UPWARDS_PX] = False
    return contour


def _find_circle(xy: Points2, heights: Float64[np.ndarray, " n"], tolerance: float) -> Circle | None:
    """Find the level circle through three points with which most others agree (RANSAC).

    The draws depend on the number of points alone, not on other regions.
    """
    picks = make_rng(0, "", "rims").integers(0, len(xy), (TRIES, 3))
    a, b, c = xy[picks[:, 0]], xy[picks[:, 1]], xy[picks[:, 2]]
    level = np.ptp(heights[picks], axis=1) < 2 * tolerance
    ab, ac = b - a, c - a
    twice = 2 * (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    usable = level & (np.abs(twice) > MIN_TRIANGLE_M2)
    if not usable.any():
        return None
    ab, ac, twice = ab[usable], ac[usable], twice[usable]
    bb, cc = (ab**2).sum(axis=1), (ac**2).sum(axis=1)
    to_center = np.stack([ac[:, 1] * bb - ab[:, 1] * cc, ab[:, 0] * cc - ac[:, 0] * bb], axis=1) / twice[:, None]
    radii, centers = np.linalg.norm(to_center, axis=1), a[usable] + to_center
    middles = heights[picks[usable]].mean(axis=1)
    sized = (radii > MIN_RADIUS_M) & (radii < MAX_RADIUS_M) & (middles > MIN_RIM_M)
    if not sized.any():
        return None
    radii, centers, middles = radii[sized], centers[sized], middles[sized]
    off = np.abs(np.linalg.norm(xy[None] - centers[:, None], axis=-1) - radii[:, None])
    agree = (off < tolerance) & (np.abs(heights[None] - middles[:, None]) < tolerance)
    best = int(agree.sum(axis=1).argmax())
    return float(centers[best, 0]), float(centers[best, 1]), float(radii[best]), float(middles[best])


def _is_on_circle(circle: Circle, xy: Points2, heights: Float64[np.ndarray, " n"], tolerance: float) -> Mask:
    x, y, radius, height = circle
    off = np.hypot(xy[:, 0] - x, xy[:, 1] - y) - radius
    return (np.abs(off) < tolerance) & (np.abs(heights - height) < tolerance)


def _refine_circle(circle: Circle, xy: Points2, heights: Float64[np.ndarray, " n"], tolerance: float) -> Circle | None:
    """Fit a circle by least squares (Kåsa 1976) to all contour points near it; None where they form none."""
    near = _is_on_circle(circle, xy, heights, 1.5 * tolerance)
    if int(near.sum()) < MIN_CONTOUR_PX:
        return None
    part = xy[near]
    middle = part.mean(axis=0)
    part = part - middle
    system = np.column_stack([2 * part, np.ones(len(part))])
    (x, y, rest), *_ = np.linalg.lstsq(system, (part**2).sum(axis=1), rcond=None)
    radius = float(np.sqrt(max(rest + x * x + y * y, 0.0)))
    if not MIN_RADIUS_M < radius < MAX_RADIUS_M:
        return None
    return float(x + middle[0]), float(y + middle[1]), radius, float(np.median(heights[near]))


def _validate_rim(circle: Circle, shown_xy: Points2, xy: Float64[np.ndarray, "h w 2"], view: TableView) -> Rim | None:
    """Accept a rim if enough of it is visible, with a hollow inside, no lid, and nothing visible beyond its walls."""
    x, y, radius, height = circle
    turns = np.arctan2(shown_xy[:, 1] - y, shown_xy[:, 0] - x) / (2 * np.pi)
    sectors = len(np.unique(np.floor(turns * RIM_SECTORS)))
    camera_height = float(view.plane.heights(np.zeros((1, 3)))[0])
    if sectors < MIN_RIM_SECTORS or camera_height <= height + MIN_CAMERA_RISE * radius:
        return None
    along = (camera_height - height) / np.maximum(camera_height - view.heights, 1e-6)
    seen = view.valid & (_compute_length(xy[..., 0] * along - x, xy[..., 1] * along - y) < OPENING * radius)
    below, off = seen & (view.heights < height - HOLLOW_M), _compute_length(xy[..., 0] - x, xy[..., 1] - y)
    hollow, through = below & (off < radius), below & (off > radius + THROUGH_M)
    least = max(MIN_HOLLOW_PX, MIN_HOLLOW_SHARE * int(seen.sum()))
    if int(hollow.sum()) < least or int(through.sum()) > MAX_THROUGH * int(seen.sum()):
        return None
    level = seen & (np.abs(view.heights - height) <= HOLLOW_M)
    if int(level.sum()) > MAX_LEVEL * int(seen.sum()) or _measure_missing(circle, view) > MAX_MISSING:
        return None
    within = seen & (view.heights < height) & ~through
    floor = float(np.percentile(view.heights[hollow], 5))
    window = expand_window(within | (off < radius + BESIDE_M), BESIDE_PX)
    return Rim(np.array([x, y]), radius, height, floor, sectors, within, window)


def _compute_length(
    x: Float64[np.ndarray, "*shape"], y: Float64[np.ndarray, "*shape"]
) -> Float64[np.ndarray, "*shape"]:
    return np.sqrt(x * x + y * y)


def _measure_missing(circle: Circle, view: TableView) -> float:
    """Measure the share of the circle where the picture shows what lies behind it, so that no wall is there."""
    x, y, radius, height = circle
    turns = np.linspace(0.0, 2 * np.pi, 2 * RIM_SECTORS, endpoint=False)
    level = np.full(len(turns), height + view.plane.offset)
    points = np.column_stack([x + radius * np.cos(turns), y + radius * np.sin(turns), level]) @ view.axes
    columns, rows = np.round(project(points, view.observation.camera)).astype(np.int64).T
    size, reach = view.valid.shape, BESIDE_PX
    inside = (rows >= reach) & (rows < size[0] - reach) & (columns >= reach) & (columns < size[1] - reach)
    if not inside.any():
        return 1.0
    around = np.arange(-reach, reach + 1)
    part = rows[inside, None, None] + around[:, None], columns[inside, None, None] + around
    nearest = np.where(view.valid[part], view.depth[part], np.inf).min(axis=(1, 2))
    behind = np.isfinite(nearest) & (nearest > points[inside, 2] + THROUGH_M)
    return float(behind.mean())


def _drop_duplicates(found: list[Rim]) -> list[Rim]:
    """Keep the most complete rims, without those whose centre lies within a kept one at about its height."""
    kept: list[Rim] = []
    for rim in sorted(found, key=lambda r: (-r.sectors, -r.radius)):
        near = (other for other in kept if abs(other.height - rim.height) < other.radius)
        if not any(float(other.distance(rim.center)) < other.radius for other in near):
            kept.append(rim)
    return kept
