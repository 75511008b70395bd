"""Merging of regions that belong to one object: parts behind an occluder, a vessel's inside, floor and wall."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.draw import line

from schemas.geometry import IdImage, Points
from tableverse_factory.geometry.math.planes import Points2, compute_convex_outline, is_inside_outline
from tableverse_factory.stages.perceive.base.table_view import TableView, expand_window
from tableverse_factory.stages.perceive.depth_segmenter.surface import DIRECTIONS, Surface, shift_image
from tableverse_factory.stages.perceive.depth_segmenter.vessel_floors import (
    NEAR_PX,
    TOUCHING_PX,
    find_floors,
    is_wall_of_floor,
    surrounds,
)

SAMPLES = 400  # pixels that stand for a larger region, or up to twice as many
TANGENT_PLANES = 60  # of these, the points whose tangent planes are compared, about

# Parts of one object that an occluder separates: a point continues a region if it lies so near to one of its tangent
# planes and faces the same way, at most 20 degrees off. Of either region at least a share of `CONTINUED` does, or
# nearly all of one and some of the other
ON_PLANE_M, SAME_DIRECTION_COS = 0.006, 0.94
CONTINUED, PART_CONTINUED, WHOLE_CONTINUED = 0.55, 0.9, 0.25
MAX_GAP_M = 0.15  # least distance of their points from one another up to which two regions may be one object
CHORD_ENDS = 10  # points of each region from which chords lead to those of the other, about
# Least shares of the chords that show nothing behind them, up to a tenth of their pixels, and that are hidden, at
# three pixels or more
MIN_CONSISTENT, MIN_HIDDEN = 0.85, 0.3
MAX_BEHIND, MIN_HIDDEN_PX = 0.1, 3
NEARER_M = 0.012  # least difference in depth by which one surface is in front of another
ACROSS_PX = 4  # depths are compared at this distance across the border of two regions
# Length of a step between two regions from which they are two objects, in square roots of the smaller one's pixels
MIN_STEP_LENGTH = 0.2

# The inside of a vessel is told by three signs: where it lies, what is seen over what, and its own shape
FOOTPRINT_SLACK_M = 0.002  # what is so far outside a wall's footprint still lies over it
# Least share of the inside over it; the latter where it is also seen over the wall
IN_FOOTPRINT, PARTLY_IN_FOOTPRINT = 0.85, 0.6
# Most that its rim may be above the wall's: by where it lies; where it is also seen over the wall; and in a hollow, of
# which it may also be so far below
RIM_SLACK_M, BACK_RIM_M, HOLLOW_RIM_M = 0.005, 0.015, 0.03
MIN_RIM_PX = 8  # length of the border along which it is seen behind the wall's rim
MAX_IN_FRONT = 0.3  # most share of the steps at their border at which it is the nearer one: rims are noisy
NEAR_SLACK_M = 0.005  # by how much the wall may begin farther from the camera, along the table
# Bulge of a region, see `measure_bulge`: 0 for a plane, the mean chord over the radius for a sphere
HOLLOW_BULGE, FLAT_BULGE = -0.15, 0.2  # most of a hollow, and of any inside or wall of a vessel: contents bulge more
MIN_CHORD_M = 0.005  # shorter chords tell nothing of it
SCRAP_SHARE = 0.25  # of a floor's pixels: a smaller region may be its wall however it bulges


@dataclass(frozen=True, slots=True, eq=False)
class MergedRegion:
    """Features of one region; n pixels are a regular sample."""

    size: int  # number of all its pixels
    pixels: Float64[np.ndarray, "n 2"]  # row and column
    points: Points  # camera frame [m]
    normals: Points
    footprint: Points2  # convex outline over the table [m]
    xy: Points2  # along the table [m]
    near: float  # 5th percentile of the distance along the table, away from the camera [m]
    rim: float  # 98th percentile of the height [m]


def describe_regions(ids: IdImage, surface: Surface, view: TableView) -> list[MergedRegion]:
    """Describe each region from 1 on by a sample of its pixels."""
    xy, heights = view.xy(surface.points), view.plane.heights(surface.points)
    found = []
    for k in range(1, int(ids.max(initial=0)) + 1):
        rows, columns = np.nonzero(ids == k)
        rim = float(np.percentile(heights[rows, columns], 98))
        footprint = compute_convex_outline(xy[rows, columns])
        step = max(1, len(rows) // SAMPLES)
        at = rows[::step], columns[::step]
        pixels = np.stack(at, axis=1).astype(np.float64)
        near = float(np.percentile(xy[at][:, 1], 5))
        sample = (surface.points[at], surface.normals[at], footprint, xy[at])
        found.append(MergedRegion(len(rows), pixels, *sample, near, rim))
    return found


def merge_occluded_parts(ids: IdImage, surface: Surface, view: TableView, *, with_vessels: bool = True) -> IdImage:
    """Merge regions that are parts of one object and renumber them from 1.

    Each region may join one other: a part seen behind an occluder the larger part, the inside of a vessel its wall.
    Then the floors of vessels join the walls around them. `with_vessels` off leaves vessels as they are.
    """
    regions = describe_regions(ids, surface, view)
    nearer = measure_occlusion(ids, surface)
    pairs: list[tuple[int, int]] = []
    for b in range(len(regions)):
        a = _find_other_part(regions, b, surface, nearer)
        if a is None and with_vessels:
            a = _find_vessel(regions, b, nearer)
        if a is not None:
            pairs.append((a + 1, b + 1))
    ids = _add_floors(ids, regions, pairs, view) if with_vessels else ids
    links = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    count = len(regions) + 1
    graph = coo_array((np.ones(len(pairs)), (links[0], links[1])), shape=(count, count))
    _, objects = connected_components(graph, directed=False)  # numbered in the order of their first regions
    values, numbered = np.unique(objects[ids], return_inverse=True)
    return numbered.reshape(ids.shape).astype(np.int32) + (0 if values[0] == 0 else 1)


def _find_other_part(
    regions: list[MergedRegion], b: int, surface: Surface, nearer: Float64[np.ndarray, "k k"]
) -> int | None:
    """Find the region of which b is a smaller part, separated from it in the picture by an occluder.

    Where one of the two is itself seen in front of the other, it ends there, however well they continue each other.
    """
    for a in sorted(range(len(regions)), key=lambda k: -regions[k].size):
        if regions[a].size <= regions[b].size:
            return None
        if max(nearer[a + 1, b + 1], nearer[b + 1, a + 1]) >= MIN_STEP_LENGTH * regions[b].size ** 0.5:
            continue
        if is_continuation(regions[a], regions[b]) and is_hidden_between(regions[a], regions[b], surface):
            return a
    return None


def _find_vessel(regions: list[MergedRegion], b: int, nearer: Float64[np.ndarray, "k k"]) -> int | None:
    """Find the region whose inside b is; of several, the one nearest to the camera along the table.

    Contents stand in front of the inside of their vessel, but behind its front wall.
    """
    shape = measure_bulge(regions[b])
    if shape > FLAT_BULGE:
        return None
    others = (a for a in range(len(regions)) if a != b)
    holders = (
        a for a in others if is_hollow_of(regions[a], regions[b], shape, nearer[a + 1, b + 1], nearer[b + 1, a + 1])
    )
    return min(holders, key=lambda a: regions[a].near, default=None)


def _add_floors(ids: IdImage, regions: list[MergedRegion], pairs: list[tuple[int, int]], view: TableView) -> IdImage:
    """Add the floors of vessels to the walls around them, and to `pairs` the walls of each."""
    proposals = find_floors(view)
    xy = view.xy(view.points_camera)
    result = ids.copy()
    for k in range(1, int(proposals.max(initial=0)) + 1):
        floor = (proposals == k) & (ids == 0)
        if not floor.any():
            continue
        part = expand_window(floor, NEAR_PX)
        floor_there, ids_there, color = floor[part], ids[part], view.observation.color[part]
        around = np.unique(ids_there[ndimage.binary_dilation(floor_there, iterations=TOUCHING_PX)])
        walls = [
            int(a)
            for a in around[around > 0]
            if (measure_bulge(regions[a - 1]) < FLAT_BULGE or regions[a - 1].size < SCRAP_SHARE * floor.sum())
            and is_wall_of_floor(floor_there, ids_there == a, color)
        ]
        if not walls or not surrounds(np.vstack([regions[a - 1].xy for a in walls]), xy[floor].mean(axis=0)):
            continue
        pairs += [(walls[0], a) for a in walls]
        result[floor] = walls[0]
    return result


def measure_occlusion(ids: IdImage, surface: Surface) -> Float64[np.ndarray, "k k"]:
    """Measure, as entry (a, b), the border along which region a is nearer to the camera than b beside it [px]."""
    count = int(ids.max(initial=0)) + 1
    depth = surface.points[..., 2]
    lengths = np.zeros((count, count))
    for rows, columns in DIRECTIONS:
        for sign in (1, -1):
            other = shift_image(ids, sign * ACROSS_PX * rows, sign * ACROSS_PX * columns)
            behind = shift_image(depth, sign * ACROSS_PX * rows, sign * ACROSS_PX * columns)
            steps = (ids > 0) & (other > 0) & (ids != other) & (behind - depth > NEARER_M)
            np.add.at(lengths, (ids[steps], other[steps]), 0.5 / ACROSS_PX)
    return lengths


def is_hollow_of(
    holder: MergedRegion, inner: MergedRegion, own_shape: float, holder_nearer: float, inner_nearer: float
) -> bool:
    """Whether `inner`, whose bulge is `own_shape`, is the inside of `holder`, as of a bowl or a mug.

    It does not bulge, as contents do, and the holder reaches as near to the camera. Three more signs count, each
    sufficient with some of the others: it lies over the holder's footprint and not above its rim; it is seen over
    the holder's rim, never the other way round; it is a hollow by its own shape.
    """
    if own_shape > FLAT_BULGE or holder.near > inner.near + NEAR_SLACK_M:
        return False
    over = float(is_inside_outline(holder.footprint, inner.xy, FOOTPRINT_SLACK_M).mean())
    rise = inner.rim - holder.rim
    never_in_front = inner_nearer <= MAX_IN_FRONT * (inner_nearer + holder_nearer)
    seen_over_rim = never_in_front and holder_nearer >= MIN_RIM_PX
    if rise <= RIM_SLACK_M and over >= IN_FOOTPRINT and never_in_front:
        return True
    if rise <= BACK_RIM_M and over >= PARTLY_IN_FOOTPRINT and seen_over_rim:
        return True
    return abs(rise) < HOLLOW_RIM_M and (seen_over_rim or over >= IN_FOOTPRINT) and own_shape < HOLLOW_BULGE


def measure_bulge(region: MergedRegion) -> float:
    """Measure the spread of a region's normals: positive where it bulges towards the viewer, negative in a hollow."""
    step = max(1, len(region.points) // TANGENT_PLANES)
    points, normals = region.points[::step], region.normals[::step]
    across, turn = points[:, None] - points[None], normals[:, None] - normals[None]
    length = np.linalg.norm(across, axis=-1)
    spread = np.einsum("ijk,ijk->ij", across, turn) / np.maximum(length, 1e-9)
    return float(spread[length > MIN_CHORD_M].mean()) if (length > MIN_CHORD_M).any() else 0.0


def is_continuation(a: MergedRegion, b: MergedRegion) -> bool:
    """Whether two regions continue each other: their points lie in the other's tangent planes, facing the same way.

    Either most of both do, or nearly all of one that continues one of the other's faces.
    """
    less, more = sorted((_measure_continuation(a, b), _measure_continuation(b, a)))
    return less >= CONTINUED or (more >= PART_CONTINUED and less >= WHOLE_CONTINUED)


def _measure_continuation(a: MergedRegion, b: MergedRegion) -> float:
    step = max(1, len(a.points) // TANGENT_PLANES)
    points, normals = a.points[::step], a.normals[::step]
    off = np.abs(b.points @ normals.T - np.einsum("ij,ij->i", points, normals))
    same = (off < ON_PLANE_M) & (b.normals @ normals.T > SAME_DIRECTION_COS)
    return float(same.any(axis=1).mean())


def is_hidden_between(a: MergedRegion, b: MergedRegion, surface: Surface) -> bool:
    """Whether an occluder hides where the two meet, and the visible depth allows them to be one object.

    Chords in the picture lead from points of the one to points of the other. Nearly none may show anything behind the
    chord (the two together are about convex), and a good part must run behind what is nearer.
    """
    gaps = np.linalg.norm(a.points[:, None] - b.points[None], axis=-1)
    if float(gaps.min()) > MAX_GAP_M:
        return False
    ends_a = range(0, len(a.points), max(1, len(a.points) // CHORD_ENDS))
    ends_b = range(0, len(b.points), max(1, len(b.points) // CHORD_ENDS))
    kinds = np.array([_trace_chord(a, i, b, j, surface) for i in ends_a for j in ends_b])
    return float(kinds[:, 0].mean()) >= MIN_CONSISTENT and float(kinds[:, 1].mean()) >= MIN_HIDDEN


def _trace_chord(a: MergedRegion, i: int, b: MergedRegion, j: int, surface: Surface) -> tuple[bool, bool]:
    """Whether a line from point i of a to point j of b shows nothing behind their surface, and whether it is hidden."""
    (r0, c0), (r1, c1) = a.pixels[i].astype(int), b.pixels[j].astype(int)
    rows, columns = line(r0, c0, r1, c1)
    expected = 1.0 / np.linspace(1.0 / a.points[i, 2], 1.0 / b.points[j, 2], len(rows))
    seen = surface.points[rows, columns, 2]
    behind = seen > expected + NEARER_M
    hidden = (seen == 0) | (seen < expected - NEARER_M)
    return float(behind.mean()) < MAX_BEHIND, int(hidden.sum()) >= MIN_HIDDEN_PX
