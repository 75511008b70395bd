"""Free-form completion by voxel carving with a prior on the hidden side.

Two priors: columns from the observed top down to the support, and a half turn about a vertical axis (objects on tables
look much the same from behind). Both are carved by all free space.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from scipy import ndimage
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError

from schemas.geometry import Frozen, Pose, TriangleMesh, Vector3
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.planes import Rectangle, fit_min_rectangle
from tableverse_factory.geometry.math.transforms import (
    invert_pose,
    multiply_quaternions,
    quaternion_about_z,
    transform_points,
)
from tableverse_factory.geometry.mesh.voxel_solids import (
    Field,
    VoxelGrid,
    extract_surface,
    find_largest_part,
    from_manifold,
    make_grid,
    simplify_solid,
    to_manifold,
)
from tableverse_factory.stages.place.completion.nelder_mead import minimize_cost
from tableverse_factory.stages.place.completion.underside import Footprint, estimate_underside
from tableverse_factory.stages.place.view.object_view import ObjectView, measure_free_space

CELLS_ON_LONGEST_SIDE = 60
CELL_RANGE_M = (0.0012, 0.006)
MAX_CELLS = 3_000_000  # of a grid, at most 20 numbers each: furniture that is taken for an object has coarser cells
MIN_THICKNESS_M = 0.003
COLUMN_CELLS = 50_000
CELLS_UP = 30
PIXELS_A_CELL = 1.5
EMPTY_M = 0.0005
TORN_SHARE = 0.1  # least volume share of a second part that counts
CRUMB_SHARE = 0.1  # number of cells of a crumb over that of the largest part
MIN_STEP_M = 0.0008
SMOOTHING_CELLS = 0.8
MAX_FACES = 3000
TURN_POINTS = 800
WORST_TURN_M = 0.01
SLACK = 0.05  # weight of distance from free space against depth in it, in the search for the axis of the half turn

Heights = Float64[np.ndarray, " nz"]


@dataclass(frozen=True, slots=True, eq=False)
class CarvedSurface(Frozen):
    """A surface as free space left it, its heights stretched: many triangles, and maybe more than one part."""

    stretched: TriangleMesh
    stretch: float
    cell: float  # of the grid that it was carved in [m]
    pose: Pose

    @property
    def mesh(self) -> TriangleMesh:
        """The whole surface in its own frame."""
        return self._shrink(self.stretched)

    def simplify(self) -> TriangleMesh:
        """Reduce the largest part to at most `MAX_FACES`."""
        solid = find_largest_part(to_manifold(self.stretched))
        return self._shrink(from_manifold(simplify_solid(solid, MAX_FACES, 0.08 * self.cell)))

    def _shrink(self, mesh: TriangleMesh) -> TriangleMesh:
        return TriangleMesh(mesh.vertices / np.array([1.0, 1.0, self.stretch]), mesh.faces)


def carve_columns(view: ObjectView) -> CarvedSurface:
    """Carve the solid below the observed points by free space, down to the support or its underside."""
    rectangle = fit_min_rectangle(view.points[:, :2])
    pose, half = place_frame(view, rectangle, rectangle.center)
    grid, stretch = build_flat_grid(view, half)
    local = grid.points() / np.array([1.0, 1.0, stretch])
    free = measure_free_space(view, local, pose).reshape(grid.shape)
    footprint, z = find_footprint(view, pose, grid), grid.axes()[2] / stretch
    field = np.minimum(compute_column_field(footprint, -half[2], z, free), free)
    if _is_torn(field):
        field = np.minimum(compute_column_field(footprint, -half[2], z, free, bridged=True), free)
    field = close_floor(field, footprint, -half[2], z)
    return CarvedSurface(extract_surface(drop_crumbs(field), grid), stretch, grid.cell, pose)


def carve_half_turn(view: ObjectView) -> CarvedSurface:
    """Carve the solid by free space, and by the same turned by half about a vertical axis for the hidden side."""
    center = _find_turn_center(view)
    turned = 2 * center - view.points[:, :2]
    rectangle = fit_min_rectangle(np.concatenate([view.points[:, :2], turned]))
    pose, half = place_frame(view, rectangle, center)
    cell = float(np.clip((2 * half).max() / CELLS_ON_LONGEST_SIDE, *CELL_RANGE_M))
    cell = _coarsen(cell, 2 * half)
    grid = make_grid(-half - cell, half + cell, cell)
    local = grid.points()
    turned_pose = Pose(pose.position, multiply_quaternions(pose.quaternion_wxyz, quaternion_about_z(np.pi)))
    free = np.minimum(measure_free_space(view, local, pose), measure_free_space(view, local, turned_pose))
    x, y, z = grid.axes()
    bounds = np.minimum(
        np.minimum((half[0] - np.abs(x))[:, None, None], (half[1] - np.abs(y))[None, :, None]),
        (half[2] - np.abs(z))[None, None, :],
    )
    reach = 2 * grid.cell
    field = np.clip(np.minimum(free.reshape(grid.shape), bounds), -reach, reach)
    smooth = ndimage.gaussian_filter(field, SMOOTHING_CELLS, mode="nearest")
    return CarvedSurface(extract_surface(drop_crumbs(smooth), grid), 1.0, cell, pose)


def place_frame(view: ObjectView, rectangle: Rectangle, center: Float64[np.ndarray, "2"]) -> tuple[Pose, Vector3]:
    """Place an upright frame about a centre with the yaw of a rectangle; returns it and half the object's size [m]."""
    top = max(float(np.quantile(view.points[:, 2], 0.998)), view.support_z + MIN_THICKNESS_M)
    half = np.array([*rectangle.half_size, (top - view.support_z) / 2])
    return Pose(np.array([*center, view.support_z + half[2]]), quaternion_about_z(rectangle.yaw)), half


def drop_crumbs(field: Field) -> Field:
    """Drop the small parts beside the solid, which cost more as surfaces than as cells; what is left is unchanged."""
    labels, count = ndimage.label(field > 0.0, structure=np.ones((3, 3, 3)))  # parts that share no cube of the surface
    if count < 2:
        return field
    sizes = np.bincount(labels.ravel())[1:]
    crumbs = np.concatenate([[False], sizes < CRUMB_SHARE * sizes.max()])
    return np.where(crumbs[labels], -np.abs(field), field)


def close_floor(field: Field, footprint: Footprint, support: float, z: Heights) -> Field:
    """Close holes where the object itself was seen, but no higher than `MIN_THICKNESS_M` over its support.

    Noise makes them in floors of bowls. What shows the table, as the middle of a ring does, stays open. `z` are
    the heights of the cells, and `support` is that of the support, in the frame of the footprint [m].
    """
    solid = (field > 0.0).any(axis=2)
    low = footprint.closed & (footprint.top < support + MIN_THICKNESS_M)
    holes = ndimage.binary_fill_holes(solid) & ~solid & low
    floor = np.minimum(z - support, support + MIN_THICKNESS_M - z)
    wider = ndimage.binary_dilation(holes)  # so that the floor joins what surrounds it
    return np.where(wider[:, :, None], np.maximum(field, floor), field)


def _coarsen(cell: float, size: Vector3, cells_up: float = 0.0) -> float:
    """Enlarge a cell [m] until a grid of this size has at most `MAX_CELLS`, one more on each side included.

    Along z there are `cells_up` at least.
    """
    while np.prod([*(size[:2] / cell + 3), max(size[2] / cell, cells_up) + 3]) > MAX_CELLS:
        cell *= 1.1
    return cell


def _find_turn_center(view: ObjectView) -> Float64[np.ndarray, "2"]:
    """Find the vertical axis: turned points must not lie in free space, but near it."""
    step = max(1, len(view.points) // TURN_POINTS)
    points = view.points[::step]

    def cost(center: Float64[np.ndarray, "2"]) -> float:
        turned = np.column_stack([2 * center - points[:, :2], points[:, 2]])
        gap = np.clip(measure_free_space(view, turned), -WORST_TURN_M, WORST_TURN_M)
        return float(np.where(gap < 0.0, -gap, SLACK * gap).mean()) + frame.distance(center)

    frame = fit_min_rectangle(points[:, :2])
    away = points[:, :2].mean(axis=0) - view.eye[:2]
    away /= max(float(np.linalg.norm(away)), 1e-9)
    reach = 0.25 * float(np.ptp(points[:, :2], axis=0).max())
    best = min((frame.center + k * reach * away for k in (-0.5, 0.0, 0.5, 1.0)), key=cost)
    return minimize_cost(cost, best, np.full(2, 0.008), 60)


def _is_torn(field: Field) -> bool:
    labels, _ = ndimage.label(field > 0.0)
    sizes = np.sort(np.bincount(labels.ravel())[1:])
    return len(sizes) > 1 and bool(sizes[-2] > TORN_SHARE * sizes.sum())


def build_flat_grid(view: ObjectView, half: Vector3) -> tuple[VoxelGrid, float]:
    """Build a grid and the stretch of its heights: flat objects need finer vertical steps."""
    size = 2 * half
    pixel = float(np.linalg.norm(view.points.mean(axis=0) - view.eye)) / view.camera.fx
    cell = min(float(np.cbrt(size.prod() / COLUMN_CELLS)), float(size.max()) / CELLS_ON_LONGEST_SIDE)
    cell = float(np.clip(cell, max(CELL_RANGE_M[0], PIXELS_A_CELL * pixel), CELL_RANGE_M[1]))
    cell = _coarsen(cell, size, CELLS_UP)
    stretch = cell / float(np.clip(size[2] / CELLS_UP, MIN_STEP_M, cell))
    scale = np.array([1.0, 1.0, stretch])
    return make_grid(-half * scale - cell, half * scale + cell, cell), stretch


def compute_column_field(
    footprint: Footprint, support: float, z: Heights, free: Field, *, bridged: bool = False
) -> Field:
    """Compute the signed distance to the columns below the observed points [m]; arguments as in `close_floor`."""
    closed, top = footprint.closed, footprint.top
    if bridged:
        closed, top = _bridge_gaps(closed, top, free, z)
    inside = ndimage.distance_transform_edt(np.pad(closed, 1))[1:-1, 1:-1]
    outside = ndimage.distance_transform_edt(~closed)
    beside = np.where(closed, inside - 0.5, 0.5 - outside) * footprint.cell
    under = estimate_underside(add_free_space(replace(footprint, closed=closed, top=top), free, z, support), support)
    top = np.maximum(top, under + MIN_THICKNESS_M)
    column = np.minimum(top[:, :, None] - z, z - under[:, :, None])
    return np.minimum(column, beside[:, :, None])


def find_footprint(view: ObjectView, pose: Pose, grid: VoxelGrid) -> Footprint:
    """Find the columns of a grid that the observed points stand in, before any free space is known."""
    local = transform_points(invert_pose(pose), view.points)
    index = np.rint((local[:, :2] - grid.origin[:2]) / grid.cell).astype(int)
    index = np.clip(index, 0, np.array(grid.shape[:2]) - 1)
    top, lowest = np.full(grid.shape[:2], -np.inf), np.full(grid.shape[:2], np.inf)
    np.maximum.at(top, (index[:, 0], index[:, 1]), local[:, 2])
    np.minimum.at(lowest, (index[:, 0], index[:, 1]), local[:, 2])
    seen = np.isfinite(top)
    if not seen.any():
        raise GeometryError("no points fall into the grid")
    closed = ndimage.binary_closing(np.pad(seen, 3), iterations=2)[3:-3, 3:-3] | seen
    nearest = ndimage.distance_transform_edt(~seen, return_distances=False, return_indices=True)
    middle = (local[:, 2].min() + local[:, 2].max()) / 2
    to_eye = transform_points(invert_pose(pose), view.eye[None])[0] - np.array([0.0, 0.0, middle])
    to_eye /= float(np.linalg.norm(to_eye))
    nothing = np.full(grid.shape[:2], view.support_z - pose.position[2])
    return Footprint(grid.cell, closed, top[nearest[0], nearest[1]], lowest, nothing, to_eye)


def add_free_space(footprint: Footprint, free: Field, z: Heights, support: float) -> Footprint:
    """Add up to which height each column was seen to be empty below its top; `z` are the heights of the cells [m]."""
    below = (free < -EMPTY_M) & (z < footprint.top[:, :, None] - EMPTY_M)
    return replace(footprint, empty_to=np.where(below, z, support).max(axis=2, initial=support))


def _bridge_gaps(
    closed: Bool[np.ndarray, "nx ny"], top: Float64[np.ndarray, "nx ny"], free: Field, z: Heights
) -> tuple[Bool[np.ndarray, "nx ny"], Float64[np.ndarray, "nx ny"]]:
    """Join separate parts over the hidden columns between them; return the columns and their tops."""
    between = np.argwhere(~closed)
    try:
        heights = LinearNDInterpolator(np.argwhere(closed), top[closed])(between)
    except QhullError:  # all columns on one line, as of a pen
        return closed, top
    spanned = np.isfinite(heights)
    between, heights = between[spanned], heights[spanned]
    level = np.clip(np.searchsorted(z, heights), 0, len(z) - 1)
    hidden = free[between[:, 0], between[:, 1], level] > 0.0
    at = tuple(between[hidden].T)
    joined, tops = closed.copy(), top.copy()
    joined[at], tops[at] = True, heights[hidden]
    return joined, tops
