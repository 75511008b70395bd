"""Detection of the table plane and its outline in a depth image."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy import ndimage

from schemas.geometry import Mask, Picture, Points, Pose
from schemas.objects import Table
from schemas.observation import Observation
from schemas.outcome import Dropped
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.planes import (
    Plane,
    Points2,
    compute_convex_outline,
    find_dominant_planes,
    fit_min_rectangle,
    fit_shared_normal,
    is_inside_outline,
    measure_depth_inside,
    refine_plane,
)
from tableverse_factory.geometry.math.transforms import pose_from_matrix, transform_points
from tableverse_factory.stages.perceive.base.table_view import TableView, compute_depth_noise, fill_depth_gaps
from tableverse_factory.stages.perceive.table_warp import fit_warp

SAMPLES = 9000  # readings in which planes are searched
MAX_PLANES = 6  # table, floor, shelf and the walls of a corner
MIN_PLANE_SHARE, MIN_PLANE_AREA_M2 = 0.02, 0.01  # of the readings; of a table in a close-up

# A plane whose normal points so far down or sideways in the picture is a wall, or the side of something.
MAX_DOWNWARD, MAX_SIDEWAYS = 0.5, 0.7

# A parallel plane over the best one is a table over its floor. Tops of boxes are lower or smaller; so high that no box
# reaches it, a table may be smaller and lean by 10 degrees, as a school desk does.
LOWEST_TABLE_OVER_FLOOR_M, MIN_RAISED_AREA_M2 = 0.25, 0.08
HIGH_OVER_FLOOR_M, MIN_HIGH_AREA_M2 = 0.45, 0.04
LEANING_COS = 0.985
PARALLEL_COS, BENT_PARALLEL_COS = 0.996, 0.98  # 5 degrees; 11 where a depth model bends the planes
MIN_SOLIDITY = 0.3  # share of its outline that a table fills: a few patches far apart are none
SUPPORT_MIN_SHARE = 0.003  # of the readings that stand above a plane which carries something

# Fit to a plane, and the shape of its surface, which sensors and models bend
BENDS = 2.0  # tolerance of the fit to a plane, in bends of a depth model
DEGREE, BENT_DEGREE = 2, 4
WARP_BAND_M, MAX_WARP_M = 0.012, 0.01  # heights that the surface is fitted to; most that a sensor warps it

# What counts as raised: heights of the lowest and the highest objects, and how far from the table-top they stand
RAISED_BENDS = 0.75
MIN_HEIGHT_M, MAX_HEIGHT_M = 0.006, 0.8
SURROUNDINGS_M = 0.25

MIN_WIDE_SHARE = 0.2  # of the readings in a plane that lie together: of an upright face's strips fewer do
MIN_TABLE_TOP_PIXELS = 2000  # of a table-top that others see, for a plane through it

# Patches of one table: cells along it, gaps of things and shadows between them, and what is too high to hide a part
CELL_M, GAP_M, COVERED_BELOW_M = 0.02, 0.2, 0.3
OUTLINE_SAMPLES = 20_000
OUTLINE_MARGIN_M = RECTANGLE_MARGIN_M = 0.03  # beyond the outline: readings on its edge; beyond footprints


@dataclass(frozen=True, slots=True, eq=False)
class _PlaneCandidate:
    plane: Plane
    share: float
    area_m2: float
    solidity: float
    supported_share: float

    @property
    def score(self) -> float:
        """Share of the picture, higher for a plane that faces up in the picture and supports objects."""
        upward = 0.2 + 0.8 * float(np.clip((0.3 - self.plane.normal[1]) / 1.3, 0.0, 1.0))
        return self.share * upward * (1.0 if self.supported_share >= SUPPORT_MIN_SHARE else 0.3)


def find_table(
    observation: Observation, rng: np.random.Generator, table_top: Mask | None = None
) -> TableView | Dropped:
    """Find the table plane among the pixels `table_top`, None for all, or the reason why there is none."""
    depth = fill_depth_gaps(observation.depth)
    points, valid = backproject(depth, observation.camera), depth > 0
    if table_top is not None and int((table_top & valid).sum()) < MIN_TABLE_TOP_PIXELS:
        why = f"{int((table_top & valid).sum())} pixels of a table-top have depth; at least {MIN_TABLE_TOP_PIXELS} must"
        return Dropped("no_table_plane", why)
    index = _sample_grid(valid if table_top is None else valid & table_top)
    sample = points[index]
    tolerance = np.maximum(0.006, 2.5 * compute_depth_noise(depth[index]))
    planes = find_dominant_planes(sample, tolerance, rng, MAX_PLANES, int(MIN_PLANE_SHARE * len(sample)))
    rated = [_rate_plane(plane.facing(np.zeros(3)), sample, inliers) for plane, inliers in planes]
    refused = [_explain_rejection(candidate) for candidate in rated]
    candidates = [candidate for candidate, reason in zip(rated, refused, strict=True) if not reason]
    if not candidates:
        why = "; ".join(refused) or f"no plane holds {MIN_PLANE_SHARE:.0%} of the {len(sample)} sampled readings"
        return Dropped("no_table_plane", why)
    chosen = _choose_plane(candidates, BENT_PARALLEL_COS if observation.bend else PARALLEL_COS)
    others = [candidate.plane for candidate in candidates if candidate is not chosen]
    return _build_view(
        observation, points, valid, valid if table_top is None else valid & table_top, chosen.plane, others
    )


def _sample_grid(valid: Mask) -> tuple[np.ndarray, np.ndarray]:
    step = max(1, int(np.sqrt(valid.sum() / SAMPLES)))
    rows, columns = np.nonzero(valid[::step, ::step])
    return rows * step, columns * step


def compute_table_axes(plane: Plane) -> Float64[np.ndarray, "3 3"]:
    """Compute the axes as rows: x to the camera's right, y away from it, z along the plane's normal."""
    right = np.array([1.0, 0.0, 0.0])
    x = right - (right @ plane.normal) * plane.normal
    if np.linalg.norm(x) < 1e-6:  # the camera lies on its side
        x = np.cross([0.0, 0.0, 1.0], plane.normal)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(plane.normal, x), plane.normal])


def _rate_plane(plane: Plane, sample: Points, inliers: Mask) -> _PlaneCandidate:
    axes = compute_table_axes(plane)
    xy = sample @ axes[:2].T
    kept, area = _find_main_region(xy[inliers])
    outline = compute_convex_outline(kept)
    heights = plane.heights(sample)
    above = (heights > 0.015) & (heights < MAX_HEIGHT_M) & is_inside_outline(outline, xy)
    solidity = len(np.unique(np.floor(kept / CELL_M), axis=0)) * CELL_M**2 / max(area, 1e-9)
    return _PlaneCandidate(plane, float(inliers.mean()), area, solidity, float(above.mean()))


def _find_main_region(xy: Points2, covered: Points2 | None = None) -> tuple[Points2, float]:
    """Find the points of the largest patch and of those near it or not much smaller, and their area [m²].

    Points over which objects stand, `covered`, connect patches: a pile may hide the middle of a table.
    """
    cells = np.floor((xy - xy.min(axis=0)) / CELL_M).astype(np.int64)
    if int(cells.max(initial=0)) > 4000:
        return xy, float("inf")
    grid = np.zeros(tuple(cells.max(axis=0) + 1), dtype=bool)
    grid[cells[:, 0], cells[:, 1]] = True
    if covered is not None:
        between = np.floor((covered - xy.min(axis=0)) / CELL_M).astype(np.int64)
        between = between[((between >= 0) & (between < grid.shape)).all(axis=1)]
        grid[between[:, 0], between[:, 1]] = True
    reach = int(GAP_M / CELL_M / 2)
    near, count = ndimage.label(ndimage.distance_transform_edt(~np.pad(grid, reach)) <= reach)
    near = near[reach:-reach, reach:-reach]
    label = near[cells[:, 0], cells[:, 1]]
    sizes = np.bincount(label, minlength=count + 1)
    kept = sizes[label] >= 0.3 * sizes.max()
    outline = compute_convex_outline(xy[kept])
    after = np.roll(outline, -1, axis=0)
    area = 0.5 * abs(float((outline[:, 0] * after[:, 1] - outline[:, 1] * after[:, 0]).sum()))
    return xy[kept], area


def _explain_rejection(candidate: _PlaneCandidate) -> str:
    (nx, ny, nz), share = candidate.plane.normal, candidate.share
    if ny > MAX_DOWNWARD or abs(nx) > MAX_SIDEWAYS:
        return f"plane of {share:.0%} faces ({nx:.2f}, {ny:.2f}, {nz:.2f}) in the camera frame: a wall or side"
    if candidate.area_m2 < MIN_PLANE_AREA_M2:
        return f"plane of {share:.0%} covers {candidate.area_m2:.4f} m², under {MIN_PLANE_AREA_M2} m²"
    return ""


def _choose_plane(candidates: list[_PlaneCandidate], parallel: float) -> _PlaneCandidate:
    """Choose the plane with the best score, unless a parallel one stands over it like a table over its floor.

    Of several such planes, as of chairs around a table, it is the one that is most of the picture with what it carries.
    """
    best = max(candidates, key=lambda c: c.score)
    raised = [c for c in candidates if c is not best and _is_table_over(c, best, parallel)]
    return max(raised, key=lambda c: c.share + c.supported_share, default=best)


def _is_table_over(table: _PlaneCandidate, floor: _PlaneCandidate, parallel: float) -> bool:
    """Whether a plane that carries something stands over another one like a table over its floor.

    High above the floor there are no tops of boxes, so that a table may be small and lean, as a school desk does.
    """
    over = table.plane.offset - floor.plane.offset
    high = over >= HIGH_OVER_FLOOR_M
    return (
        over >= LOWEST_TABLE_OVER_FLOOR_M
        and float(table.plane.normal @ floor.plane.normal) > (min(parallel, LEANING_COS) if high else parallel)
        and table.area_m2 >= (MIN_HIGH_AREA_M2 if high else MIN_RAISED_AREA_M2)
        and table.solidity >= MIN_SOLIDITY
        and table.supported_share >= SUPPORT_MIN_SHARE
    )


def _build_view(
    observation: Observation,
    points: Float64[np.ndarray, "h w 3"],
    valid: Mask,
    top: Mask,
    found: Plane,
    others: list[Plane],
) -> TableView | Dropped:
    noise, bend = compute_depth_noise(points[..., 2]), observation.bend
    tolerance = np.maximum(np.maximum(0.005, 2.5 * noise), BENDS * bend * points[..., 2])
    plane = refine_plane(found, points[top], tolerance[top]).facing(np.zeros(3))
    if bend:
        plane = _level_plane(plane, others, points[top], tolerance[top])
    axes = compute_table_axes(plane)
    heights = np.where(valid, plane.heights(points), 0.0)
    xy = points @ axes[:2].T
    flat = valid & (np.abs(heights) <= tolerance)
    wide = _remove_strips(flat, float(np.median(tolerance[flat] / points[flat, 2])) * observation.camera.fx)
    n_flat, n_wide = int(flat.sum()), int(wide.sum())
    if n_wide < MIN_WIDE_SHARE * n_flat:
        return Dropped("no_table_plane", f"of {n_flat} readings in one plane only {n_wide} lie together")
    covered = valid & (heights > tolerance) & (heights < COVERED_BELOW_M)
    kept, _ = _find_main_region(_thin(xy[wide]), _thin(xy[covered]))
    outline = compute_convex_outline(kept)
    depth_over = measure_depth_inside(outline, xy)
    over = valid & (depth_over >= -OUTLINE_MARGIN_M)
    reach = BENDS * bend * float(np.median(points[flat, 2]))
    level = over & (np.abs(heights) <= max(WARP_BAND_M, reach))
    warp = fit_warp(xy, heights, level, max(MAX_WARP_M, reach), BENT_DEGREE if bend else DEGREE)
    lift = np.where(valid, heights - warp, 0.0)
    around = valid & (depth_over >= -SURROUNDINGS_M)
    least = np.maximum(np.maximum(MIN_HEIGHT_M, 3 * noise), RAISED_BENDS * bend * points[..., 2])
    raised = around & (lift > least) & (heights < MAX_HEIGHT_M)
    on_plane = over & (np.abs(lift) <= least)
    return TableView(observation, points, valid, plane, axes, outline, heights, on_plane, raised)


def _level_plane(plane: Plane, others: list[Plane], points: Points, tolerance: Float64[np.ndarray, " n"]) -> Plane:
    """Turn the plane about its middle to the normal that it shares with the floor, shelves and other parallel planes.

    A wide floor tells more about gravity than a small table. Points are weighted by angle, not by metres: a depth model
    bends far ones by more.
    """
    step = max(1, len(points) // SAMPLES)
    points, tolerance = points[::step], tolerance[::step]
    patches, left = [], np.ones(len(points), dtype=bool)
    for level in [plane, *(other for other in others if float(other.normal @ plane.normal) > BENT_PARALLEL_COS)]:
        near = left & (np.abs(level.heights(points)) <= tolerance)
        left &= ~near
        patches.append(points[near])
    if len(patches[0]) < 3:
        return plane
    normal = fit_shared_normal([patch / np.median(patch[:, 2]) for patch in patches if len(patch)])
    return Plane(normal, float(normal @ patches[0].mean(axis=0))).facing(np.zeros(3))


def _thin(xy: Points2) -> Points2:
    return xy[:: max(1, len(xy) // OUTLINE_SAMPLES)]


def _remove_strips(flat: Mask, tolerance_px: float) -> Mask:
    """Remove strips as narrow as those where an upright face crosses the plane's height."""
    size = 2 * int(np.ceil(min(1.2 * tolerance_px, max(flat.shape)))) + 1  # a wider window sees no more
    core = ndimage.minimum_filter(flat.astype(np.uint8), size, mode="nearest")
    return flat & (ndimage.maximum_filter(core, size) > 0)


def compute_camera_to_table(view: TableView, object_points: Points) -> Pose:
    """Compute the camera's pose in the table frame; its origin lies under the middle of the objects' rectangle."""
    center = fit_min_rectangle(compute_convex_outline(view.xy(object_points))).center
    matrix = np.eye(4)
    matrix[:3, :3] = view.axes
    matrix[:3, 3] = [-center[0], -center[1], -view.plane.offset]
    return pose_from_matrix(matrix)


def fit_table_rectangle(view: TableView, pose: Pose, object_points: Points, color: Picture) -> Table:
    """Fit the rectangle around the visible table-top and, with a margin, the footprints of all objects."""
    footprint = transform_points(pose, object_points)[:, :2]
    corners = compute_convex_outline(footprint)
    spread = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * RECTANGLE_MARGIN_M
    top = transform_points(pose, view.points_camera[view.on_plane])
    outline = compute_convex_outline(top[:, :2])
    rectangle = fit_min_rectangle(np.vstack([outline, (corners[:, None] + spread).reshape(-1, 2)]))
    mean = color[view.on_plane].mean(axis=0).round().astype(int)
    rms = float(np.sqrt(np.mean(top[:, 2] ** 2)))
    return Table(rectangle.center, rectangle.half_size, rectangle.yaw, (int(mean[0]), int(mean[1]), int(mean[2])), rms)
