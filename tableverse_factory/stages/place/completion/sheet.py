"""Free-form sheets of one thickness, such as oval dishes, trays and spoon rests: the underside follows the upper side.

A surface that sags below the chords of its rim is open upward, and where the picture shows the background below that
rim, the thing is no solid: its visible edge tells the thickness of all of it. The sheet is all that lies within half a
thickness of a middle surface, which lies as deep below the seen one.
"""

import numpy as np
from scipy import ndimage
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError, cKDTree

from schemas.geometry import Points
from tableverse_factory.geometry.math.planes import fit_min_rectangle
from tableverse_factory.geometry.math.transforms import invert_pose, transform_points
from tableverse_factory.geometry.mesh.voxel_solids import extract_surface
from tableverse_factory.stages.place.completion.underside import Footprint, measure_raised_edge
from tableverse_factory.stages.place.completion.voxel_carving import (
    CarvedSurface,
    add_free_space,
    build_flat_grid,
    drop_crumbs,
    find_footprint,
    place_frame,
)
from tableverse_factory.stages.place.view.object_view import ObjectView, measure_free_space

SAG_M = 0.002  # least median depth below the chords of the rim [m]: flat things have 0.5 mm of noise
MAX_HEIGHT = 0.4  # of a sheet, of its length: what is higher is a vessel, whose contents are no part of a wall
RAISED_SHARE = 0.5  # least share of the visible border that ends above the support
THICKNESS_RANGE_M = (0.003, 0.015)
RIM_CELLS = 2
MIDDLE_POINTS = 6000
BRIDGE_M = 0.003  # spacing of the points that continue the middle surface where the sheet hides itself [m]
BAND = 3  # clamp of the field, in cells


def carve_sheet(view: ObjectView) -> CarvedSurface | None:
    """Carve a sheet by free space; None where the picture does not show one."""
    rectangle = fit_min_rectangle(view.points[:, :2])
    pose, half = place_frame(view, rectangle, rectangle.center)
    if half[2] > MAX_HEIGHT * half[:2].max():
        return None
    grid, stretch = build_flat_grid(view, half)
    footprint = find_footprint(view, pose, grid)
    if _measure_sag(footprint) < SAG_M:
        return None
    local = grid.points() / np.array([1.0, 1.0, stretch])
    free = np.minimum(measure_free_space(view, local, pose), local[:, 2] + half[2]).reshape(grid.shape)
    footprint = add_free_space(footprint, free, grid.axes()[2] / stretch, -half[2])
    raised, thickness = measure_raised_edge(footprint, -half[2])
    if raised < RAISED_SHARE or thickness > THICKNESS_RANGE_M[1]:
        return None
    radius = max(thickness, THICKNESS_RANGE_M[0]) / 2
    step = max(1, len(view.points) // MIDDLE_POINTS)
    middle = _continue_hidden(view, view.points[::step] - radius * view.normals[::step])
    reach = BAND * grid.cell
    near = cKDTree(transform_points(invert_pose(pose), middle))
    distance, _ = near.query(local, distance_upper_bound=radius + reach)
    field = np.clip(np.minimum(free, radius - distance.reshape(grid.shape)), -reach, reach)
    return CarvedSurface(extract_surface(drop_crumbs(field), grid), stretch, grid.cell, pose)


def _measure_sag(footprint: Footprint) -> float:
    """Measure the median depth of the surface below the chords between points of its rim [m], negative above them."""
    inner = ndimage.binary_erosion(np.pad(footprint.closed, 1), iterations=RIM_CELLS)[1:-1, 1:-1]
    rim = footprint.closed & ~inner
    try:
        chords = LinearNDInterpolator(np.argwhere(rim), footprint.top[rim])(np.argwhere(inner))
    except QhullError:  # all of the rim on one line
        return 0.0
    sag = (chords - footprint.top[inner])[np.isfinite(chords)]
    return float(np.median(sag)) if len(sag) else 0.0


def _continue_hidden(view: ObjectView, middle: Points) -> Points:
    """Continue a surface linearly over what it hides itself [m]."""
    low, high = middle[:, :2].min(axis=0), middle[:, :2].max(axis=0)
    axes = [np.arange(low[k], high[k], BRIDGE_M) for k in range(2)]
    between = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    between = between[cKDTree(middle[:, :2]).query(between)[0] > BRIDGE_M]
    if len(between) == 0:
        return middle
    try:
        heights = LinearNDInterpolator(middle[:, :2], middle[:, 2])(between)
    except QhullError:  # all of the points on one line
        return middle
    added = np.column_stack([between, heights])[np.isfinite(heights)]
    return np.concatenate([middle, added[measure_free_space(view, added) > 0.0]])
