"""Profile curve of a surface of revolution, carved by free space over all azimuths, with its observed cavity."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from manifold3d import CrossSection, FillRule, JoinType
from scipy import ndimage
from skimage.measure import find_contours

from schemas.geometry import Points, Pose
from tableverse_factory.geometry.math.transforms import invert_pose, rotation_matrix, transform_points
from tableverse_factory.stages.place.completion.ring_votes import (
    Cells,
    Field,
    Profile,
    RingVotes,
    collect_votes,
    is_upright,
)
from tableverse_factory.stages.place.view.object_view import ObjectView

WALL_RANGE_M = (0.001, 0.012)
USUAL_WALL_M = 0.002  # of a wall of which neither the outside nor the rim was seen
RIM_HEIGHT_M, RIM_TOP_M = 0.004, 0.003  # below the rim, in which the cavity's mouth and the points of the rim lie
RIM_INSIDE_M, RIM_OUTSIDE_M = 0.002, 0.012  # beside the mouth, within which they do: handles reach further
RIM_SHARE = 0.9  # of them, within the rim's width: the rest is noise
MOST_RIM_WALL_M = 0.006  # of a wall as thick as its rim: a wider rim is one that is rolled
WALL_POINTS, LEAST_POINTS = 300, 30
LIP_HEIGHT_M = 0.008  # next to the rim, over which a lip may turn outward and down: a rolled edge is lower
LIP_M = 0.004  # height next to rim and floor over which a wall is not measured: both are rounded
# Least height of a floor that the cavity's own wall hid: deep cups stand on a thick one or on a ring.
HIDDEN_FLOOR_M = 0.004
OUTWARD = 0.3  # part of a normal that points away from the axis, from which it is one of the outside
FLAT = 0.2  # most sideways part of the normal of a level floor
FLOOR_SHARE = 0.9  # part of a cavity's radius within which level points are its floor
FLOOR_CELLS = 2  # height above the lowest open cell up to which they are
MIN_HOLLOW_M = 0.008
HOLLOW_TILT_COS = 0.8
SLICE_M = 0.002
SEEN_CELLS = 2  # of a ring, from which its surface was seen
EDGE_ROWS = 5  # over which its width is taken
DETAIL_M = 0.0002
SWELLINGS = (0.0, 0.4, 0.8)
NOISY_HOLLOW_SHARE = 0.25  # least depth of a cavity in noise, as a share of the height
BORED_SHARE = 0.6  # widest hole in a solid as a share of the body's width; a wider cavity has a wall around it
LID_WIDTH = 0.6  # middle of a mouth, as a share of its radius
LID_DEPTH = 0.25  # of a lid below the rim, as a share of the cavity's: a wall that slants up from the floor is no lid
LID_POINTS = 20
FLOOR_POINTS = 20
CONTENTS_M = 0.002  # what rises further from the median of its ring lies in the vessel, or is noise [m]
RESTING_M = 0.001  # most height of a wall's lowest part at which it rests on the support itself, without a foot [m]
FOOT_RING_M = 0.0025  # least width of the ring on which a floor above the support stands [m]
HOLLOW_FOOT_M = (0.0008, 0.008)  # hollow gaps below a floor: narrower ones are filled, taller ones are no foot ring


def fit_profile(view: ObjectView, axis: Pose) -> tuple[CrossSection, CrossSection] | None:
    """Fit the section in the plane of distance and height [m], and its cavity's; None where nothing is left."""
    points = transform_points(invert_pose(axis), view.points)
    normals = view.normals @ rotation_matrix(axis.quaternion_wxyz)
    profile = np.stack([np.linalg.norm(points[:, :2], axis=1), points[:, 2]], axis=1)
    outward = (points[:, :2] * normals[:, :2]).sum(axis=1) / np.maximum(profile[:, 0], 1e-9)
    votes = collect_votes(view, axis, profile)
    if votes is None:
        return None
    if rotation_matrix(axis.quaternion_wxyz)[2, 2] > HOLLOW_TILT_COS:
        for swelling in SWELLINGS:
            # A wall thinner than the noise is voted away: swollen a little it stands, and is then set back.
            swollen = replace(votes, field=votes.field + swelling * votes.band)
            least = max(MIN_HOLLOW_M, NOISY_HOLLOW_SHARE * float(np.ptp(profile[:, 1])) if swelling else 0.0)
            cavity = _find_cavity_cells(swollen, least)
            if cavity is not None and _has_lid(swollen, cavity, profile):
                break
            if cavity is not None and _is_bored(swollen, cavity):
                body, hole = _build_solid(votes), _build_cavity(swollen, cavity, swelling * votes.band)
                return body - hole, hole
            if cavity is not None:
                inside = points[outward < OUTWARD] if is_upright(axis) else None
                return _build_thin_wall(swollen, cavity, profile, outward, inside, swelling * votes.band)
    section = _build_solid(votes)
    return None if section.is_empty() else (section, CrossSection())


def _find_cavity_cells(votes: RingVotes, least: float) -> Cells | None:
    """Find the empty cells of a cavity that opens upward around the axis; None where none is `least` deep [m]."""
    solid = votes.field > 0.0
    rows = np.flatnonzero(solid.any(axis=0))
    if len(rows) == 0:
        return None
    rim = int(rows[-1])
    within = np.flip(np.maximum.accumulate(np.flip(solid, axis=0), axis=0), axis=0)
    empty = votes.field < 0.0
    # Contents hide parts of a cavity: what they hide counts as open if it joins what was seen to be open.
    labels, _ = ndimage.label((empty | votes.hidden) & within)
    at_mouth = labels[:2, max(rim - 3, 0) : rim + 1]
    open_at_mouth = np.unique(at_mouth[at_mouth > 0])
    if len(open_at_mouth) == 0:
        return None
    largest = open_at_mouth[np.argmax(np.bincount(labels.ravel())[open_at_mouth])]
    cavity: Cells = np.asarray(labels == largest)
    seen_rows = np.flatnonzero((cavity & empty).sum(axis=0) >= 2)
    if votes.cell * len(seen_rows) < least:
        return None
    # Below the lowest height that was seen to be open nothing says that the hidden middle is open.
    cavity[:, : seen_rows[0]] = False
    return cavity


def _measure_wall_across(hole: CrossSection, outer: Profile, low: float, high: float) -> float:
    """Measure a wall between its cavity and the points seen outside [m]; NaN where too few lie beside it.

    Those whose nearest point of the cavity is not between the heights `low` and `high` belong to the lip or the foot.
    """
    loop = max((np.asarray(loop) for loop in hole.to_polygons()), key=_compute_area)
    along = np.roll(loop, -1, axis=0) - loop
    step = max(1, len(outer) // WALL_POINTS)
    points = outer[::step, None]
    share = ((points - loop) * along).sum(axis=-1) / np.maximum((along**2).sum(axis=-1), 1e-18)
    nearest = loop + np.clip(share, 0.0, 1.0)[..., None] * along
    distance = np.linalg.norm(points - nearest, axis=-1)
    best = distance.argmin(axis=1)
    height = nearest[np.arange(len(best)), best, 1]
    beside = (height > low) & (height < high)
    if beside.sum() * step < LEAST_POINTS:
        return np.nan
    return float(np.clip(np.median(distance.min(axis=1)[beside]), *WALL_RANGE_M))


def _measure_rim(hole: CrossSection, profile: Profile, rim: float) -> float:
    """Measure a wall by the width of its rim, at the height `rim` [m]; a usual one where too few points lie there."""
    corners = np.concatenate([np.asarray(loop) for loop in hole.to_polygons()])
    radii = corners[(corners[:, 1] > rim - RIM_HEIGHT_M) & (corners[:, 1] < rim), 0]
    if len(radii) == 0:
        return USUAL_WALL_M
    beyond = profile[profile[:, 1] > rim - RIM_TOP_M, 0] - float(radii.max())
    beyond = beyond[(beyond > -RIM_INSIDE_M) & (beyond < RIM_OUTSIDE_M)]
    if len(beyond) < LEAST_POINTS:
        return USUAL_WALL_M
    return float(np.clip(np.quantile(beyond, RIM_SHARE), USUAL_WALL_M, MOST_RIM_WALL_M))


def _measure_inside_height(votes: RingVotes, inside: Points, mouth: float) -> float:
    """Measure the least height of the seen inside over the support [m]: what rests there is no thicker.

    A vessel that leans a little or is bent rests on few points, where its inside is lower than that of the whole ring.
    `inside` are points about the axis, shape (n, 3) [m].
    """
    rings = np.floor(np.linalg.norm(inside[:, :2], axis=1) / SLICE_M).astype(int)
    count = np.bincount(rings)
    known = np.flatnonzero(count[: int(mouth / SLICE_M)] >= FLOOR_POINTS)
    if len(known) == 0:
        return np.inf
    middle = np.full(len(count), np.inf)
    middle[known] = [np.median(inside[rings == k, 2]) for k in known]
    above = inside[:, 2] - middle[rings]
    near = np.abs(above) < CONTENTS_M
    x, y = inside[near, 0], inside[near, 1]
    bends = np.stack([x, y, x**2 - y**2, 2 * x * y], axis=1)
    rise = bends @ np.linalg.lstsq(bends, above[near], rcond=None)[0]
    lowest = np.full(len(count), np.inf)
    np.minimum.at(lowest, rings[near], rise)
    return float((middle[known] + lowest[known]).min()) - votes.bottom


def _build_thin_wall(
    votes: RingVotes,
    cavity: Cells,
    profile: Profile,
    outward: Float64[np.ndarray, " n"],
    inside: Points | None,
    swelling: float,
) -> tuple[CrossSection, CrossSection]:
    """Build the observed outer surface, else a wall around the cavity, with a foot below and the cavity removed."""
    outer = _find_outer_profile(votes, cavity, profile, outward)
    rim = votes.bottom + votes.cell * (int(np.flatnonzero(cavity.any(axis=0))[-1]) + 1)
    flat = profile[np.abs(outward) < FLAT]
    completed, floor_z = _complete_cavity(votes, cavity, outer, USUAL_WALL_M, flat)
    seen = _build_cavity(votes, completed, swelling)
    wall = _measure_wall_across(seen, profile[outward > OUTWARD], floor_z + LIP_M, rim - LIP_M)
    wall = _measure_rim(seen, profile, rim) if np.isnan(wall) else wall
    mouth = votes.cell * float(cavity.sum(axis=0).max())
    lowest = np.inf if inside is None else _measure_inside_height(votes, inside, mouth)
    wall = max(min(wall, lowest), WALL_RANGE_M[0])
    completed, floor_z = _complete_cavity(votes, cavity, outer, wall, flat)
    hole = _build_cavity(votes, completed, swelling)
    solid = _swell(hole, wall)
    carved = _build_solid(votes)
    if len(outer) >= 2:
        solid = solid + (_fill_profile(outer) - _find_lip_core(votes, carved, rim, wall))
    if lowest - wall > RESTING_M:
        solid = _add_foot(solid, votes, completed, outer, floor_z, wall)
    # Free space seen from outside limits all guesses; a wall of the least thickness stays whatever the noise.
    least = _swell(hole, WALL_RANGE_M[0]) ^ _build_rectangle(2.0, votes.bottom, rim)
    sealed = hole - _build_rectangle(2.0, votes.bottom - 1.0, votes.bottom + WALL_RANGE_M[0])
    return _fill_voids((((solid ^ carved) + least) - sealed).simplify(DETAIL_M)), sealed


def _find_lip_core(votes: RingVotes, carved: CrossSection, rim: float, wall: float) -> CrossSection:
    """Find what lies deeper than the wall below free space, next to the rim: a lip that turns outward is no thicker."""
    free = _build_rectangle(2.0, votes.bottom - 1.0, rim + 1.0) - carved
    return _build_rectangle(2.0, rim - LIP_HEIGHT_M, rim + LIP_M) - _swell(free, wall)


def _fill_voids(section: CrossSection) -> CrossSection:
    """Fill what no way leads out of: the core of a lip thicker than its wall."""
    return CrossSection([loop for loop in section.to_polygons() if _compute_signed_area(loop) > 0.0], FillRule.NonZero)


def _add_foot(
    solid: CrossSection, votes: RingVotes, cavity: Cells, outer: Profile, floor_z: float, wall: float
) -> CrossSection:
    """Add what carries a floor above the support: a ring where the gap below it is that of one, else all of it."""
    rows = np.flatnonzero(cavity.any(axis=0))
    floor = cavity[:, min(int(rows[0]) + max(1, round(0.002 / votes.cell)), cavity.shape[1] - 1)]
    reach = max(float(floor.sum()) * votes.cell, 2 * votes.cell)
    # The outside seen below the floor is that of the foot, which may be wider than the floor.
    if len(outer) >= 2 and outer[0, 1] < floor_z:
        reach = float(outer[0, 0])
    footed = solid + _build_rectangle(reach, votes.bottom, floor_z + wall / 2)
    gap = floor_z - wall - votes.bottom
    if not HOLLOW_FOOT_M[0] < gap < HOLLOW_FOOT_M[1]:
        return footed
    within = max(reach - max(wall, FOOT_RING_M), 0.0)
    return footed - _build_rectangle(within, votes.bottom - 1.0, votes.bottom + gap)


def _has_lid(votes: RingVotes, cavity: Cells, profile: Profile) -> bool:
    """Whether the middle of the mouth was seen to be closed: an occluder of a can leaves votes for a cavity."""
    rows = np.flatnonzero(cavity.any(axis=0))
    mouth = votes.cell * float(cavity[:, max(int(rows[-1]) - 3, 0) : int(rows[-1]) + 1].sum(axis=0).max())
    rim, depth = votes.bottom + votes.cell * (int(rows[-1]) + 1), votes.cell * (int(rows[-1]) + 1 - int(rows[0]))
    middle = profile[profile[:, 0] < LID_WIDTH * mouth, 1]
    return len(middle) >= LID_POINTS and float((middle > rim - LID_DEPTH * depth).mean()) > 0.5


def _is_bored(votes: RingVotes, cavity: Cells) -> bool:
    """Whether the cavity is a narrow hole in a solid rather than the inside of a wall."""
    body = np.flatnonzero((votes.field > 0.0).any(axis=1))
    return int(cavity.sum(axis=0).max()) < BORED_SHARE * int(body[-1])


def _build_solid(votes: RingVotes) -> CrossSection:
    """Build the largest section that the votes allow: what was not seen is solid.

    Where whole rings were hidden between others, as behind what stands before a lying can, they go on from one to the
    other.
    """
    field, count = votes.field, votes.field.shape[0]
    seen = np.flatnonzero((field > 0.0).sum(axis=0) >= SEEN_CELLS)
    unseen = np.full(field.shape, votes.band)
    if len(seen):
        hidden = np.setdiff1d(np.arange(seen[0], seen[-1]), seen)
        edges = count - np.argmax(field[::-1, seen] > 0.0, axis=0)
        edges = ndimage.median_filter(edges, EDGE_ROWS, mode="nearest")  # next to what hides them they are noisy
        inside = np.interp(hidden, seen, edges) - np.arange(count)[:, None] - 0.5
        unseen[:, hidden] = np.clip(votes.cell * inside, -votes.band, votes.band)
    return _trace_outline(np.where(np.isnan(field), unseen, field), votes)


def _build_cavity(votes: RingVotes, cavity: Cells, swelling: float) -> CrossSection:
    inner = np.where(cavity, np.where(np.isnan(votes.field), -votes.band, np.minimum(votes.field, 0.0)), votes.band)
    inner = np.where(~cavity & (votes.field > 0.0), votes.field, inner)
    return _swell(_trace_outline(inner, votes, open_top=True), swelling)


def _find_outer_profile(
    votes: RingVotes, cavity: Cells, profile: Profile, outward: Float64[np.ndarray, " n"]
) -> Profile:
    """Find the distance of the outer surface by height, from slices in which it was seen, lowest first.

    Points within the reach of the cavity lie on its floor, whose noise turns normals outward.
    """
    slices = np.floor(profile[:, 1] / SLICE_M).astype(int)
    index = np.arange(cavity.shape[0])[:, None]
    reach = votes.cell * np.where(cavity, index + 1, 0).max(axis=0)
    lowest = int(np.flatnonzero(reach)[0])
    reach[max(lowest - FLOOR_CELLS, 0) : lowest] = reach[lowest]
    row = np.clip(((profile[:, 1] - votes.bottom) / votes.cell).astype(int), 0, len(reach) - 1)
    outer = (outward > OUTWARD) & (profile[:, 0] > reach[row] + votes.cell)
    rows = [k for k in np.unique(slices[outer]) if (outer & (slices == k)).sum() >= 5]
    return np.array([[np.median(profile[outer & (slices == k), 0]), (k + 0.5) * SLICE_M] for k in rows]).reshape(-1, 2)


def _complete_cavity(
    votes: RingVotes, cavity: Cells, outer: Profile, wall: float, flat: Profile
) -> tuple[Cells, float]:
    """Complete the cavity by cells that its own wall hid, down to the visible floor or to a usual one.

    `flat` are the points of the profile whose surface is level.
    """
    unknown = np.isnan(votes.field)
    rows = np.flatnonzero(cavity.any(axis=0))
    edges = {int(k): int(np.flatnonzero(cavity[:, k])[-1]) for k in rows}
    walled = [k for k, edge in edges.items() if (votes.field[edge + 1 : edge + 3, k] > 0.0).any()]
    lowest = walled[0] if walled else int(rows[0])
    completed = cavity.copy()
    index = np.arange(cavity.shape[0])
    for k in range(lowest, int(rows[-1]) + 1):
        completed[:, k] |= unknown[:, k] & (index <= edges.get(k, -1))
    radius = int(completed[:, lowest].sum())
    below = votes.field[: max(int(0.7 * radius), 1), max(lowest - 3, 0) : lowest + 1]
    if float((below > 0.0).any(axis=1).mean()) > 0.3:
        return completed, votes.bottom + votes.cell * lowest
    near = (flat[:, 0] < FLOOR_SHARE * radius * votes.cell) & (
        flat[:, 1] < votes.bottom + votes.cell * (lowest + FLOOR_CELLS)
    )
    if near.sum() >= LEAST_POINTS:
        return completed, min(float(np.median(flat[near, 1])), votes.bottom + votes.cell * lowest)
    floor = min(max(int(np.ceil(max(wall, HIDDEN_FLOOR_M) / votes.cell)), 1), lowest)
    for k in range(floor, lowest):
        z = votes.bottom + (k + 0.5) * votes.cell
        limit = radius * votes.cell
        if len(outer) >= 2 and z >= outer[0, 1] - SLICE_M:
            limit = min(limit, float(np.interp(z, outer[:, 1], outer[:, 0])) - wall)
        completed[:, k] |= (index + 0.5) * votes.cell <= limit
    return completed, votes.bottom + votes.cell * floor


def _trace_outline(field: Field, votes: RingVotes, *, open_top: bool = False) -> CrossSection:
    """Trace the largest region of positive (or, for a cavity open at the top, negative) cells as a section [m]."""
    inside = -field if open_top else field
    nr = inside.shape[0]
    if open_top:
        rim = int(np.flatnonzero((inside > 0.0).any(axis=0))[-1])
        inside = np.concatenate([inside[:, : rim + 1], np.repeat(inside[:, rim : rim + 1], 12, axis=1)], axis=1)
    both = np.concatenate([inside[::-1], inside], axis=0)
    both = np.where(np.abs(both) < 1e-7, -1e-7, both)
    padded = np.pad(both, 1, constant_values=-votes.band)
    if not open_top:
        padded[:, 0] = -padded[:, 1]
    loops = [
        np.stack([(c[:, 0] - 0.5 - nr) * votes.cell, votes.bottom + (c[:, 1] - 0.5) * votes.cell], axis=1)
        for c in find_contours(padded, 0.0)
    ]
    loop = max(loops, key=_compute_area, default=None)
    if loop is None or _compute_area(loop) < 4 * votes.cell**2:
        return CrossSection()
    return CrossSection([loop[:-1]], FillRule.NonZero).simplify(DETAIL_M)


def _fill_profile(outer: Profile) -> CrossSection:
    """Fill the outer profile over the heights where it was seen."""
    section = CrossSection()
    for run in np.split(outer, np.flatnonzero(np.diff(outer[:, 1]) > 3.5 * SLICE_M) + 1):
        right = np.vstack([[run[0, 0], run[0, 1] - SLICE_M / 2], run, [run[-1, 0], run[-1, 1] + SLICE_M / 2]])
        left = right[::-1] * np.array([-1.0, 1.0])
        section = section + CrossSection([np.vstack([right, left])], FillRule.NonZero)
    return section


def _swell(section: CrossSection, distance: float) -> CrossSection:
    return section.offset(distance, JoinType.Round, circular_segments=24)


def _build_rectangle(reach: float, low: float, high: float) -> CrossSection:
    corners = np.array([[-reach, low], [reach, low], [reach, high], [-reach, high]])
    return CrossSection([corners], FillRule.NonZero)


def _compute_area(loop: Profile) -> float:
    return abs(_compute_signed_area(loop))


def _compute_signed_area(loop: Profile) -> float:
    """Compute the area of a loop, negative for one that runs clockwise, about a void."""
    x, y = loop[:, 0], loop[:, 1]
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2
