"""Whether one of the ten relations holds between two bodies: one answer for rules, checks and trajectories.

The viewer stands at the camera's side of the table and looks along +y: left is -x, right +x, in front -y, behind +y.
Directions compare boxes, so `left` is the converse of `right` exactly; containment and support look at the shapes.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from schemas.curation import Relation
from schemas.geometry import Frozen, TriangleMesh, Vector3
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.planes import Points2, compute_convex_outline
from tableverse_factory.geometry.mesh.height_maps import (
    CELL_M,
    Cavity,
    CellMask,
    HeightMap,
    compute_column_center,
    compute_height_map,
    find_cavity,
    find_flat_cells,
    rotate_quarter_turn,
)
from tableverse_factory.geometry.mesh.raycasting import RaycastingScene, make_raycasting_scene

# Axis and sign of each side.
SIDES = {Relation.LEFT: (0, -1), Relation.RIGHT: (0, 1), Relation.IN_FRONT: (1, -1), Relation.BEHIND: (1, 1)}
NEXT_TO_GAP_M = 0.06
SIDE_OVERLAP_M = 0.01  # how far boxes may overlap along the axis and still lie beside each other
CONTACT_GAP_M = 0.005
SUBMERGED_M = 0.01  # how deep below the rim a body must reach to be in the vessel; half its height will do for the flat
_INSIDE_SHARE = 0.85
_FAR_M = 1e3
_OUTLINE_ANGLES = (np.arange(64) + 0.5) * (2 * np.pi / 64)
_OUTLINE_DIRECTIONS = np.stack([np.cos(_OUTLINE_ANGLES), np.sin(_OUTLINE_ANGLES)], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class BodyFeatures(Frozen):
    """A body in the table frame: its box, its convex outline from above in order (n, 2), the centre of its columns [m].

    The cavity is there where it is a vessel that stands open; on the flat cells of its map objects could stand.
    """

    low: Vector3
    high: Vector3
    outline: Points2
    center: Vector3
    heights: HeightMap
    cavity: Cavity | None
    flat: CellMask

    def moved(self, cells: tuple[int, int], rise: float) -> "BodyFeatures":
        """Move the body by whole cells of its map and lift it by `rise` [m]."""
        offset = np.array([cells[0] * self.heights.cell, cells[1] * self.heights.cell, rise])
        cavity = self.cavity
        if cavity is not None:
            cavity = replace(cavity, rim_z=cavity.rim_z + rise, floor_z=cavity.floor_z + rise)
        return replace(
            self,
            low=self.low + offset,
            high=self.high + offset,
            outline=self.outline + offset[:2],
            center=self.center + offset,
            heights=self.heights.shifted(cells, rise),
            cavity=cavity,
        )


def compute_body_features(
    mesh: TriangleMesh, caster: RaycastingScene | None = None, cell: float = CELL_M
) -> BodyFeatures:
    """Compute the features of a mesh in the table frame; `caster` holds the same mesh, where there is one already."""
    heights = compute_height_map(mesh, caster or make_raycasting_scene(mesh), cell)
    low, high = aabb(mesh.vertices)
    return _make_features(low, high, compute_outline(mesh.vertices[:, :2]), heights)


def rotate_body_quarter_turn(body: BodyFeatures) -> BodyFeatures:
    """Rotate a body by 90° about the z axis of the table frame."""
    low = np.array([-body.high[1], body.low[0], body.low[2]])
    high = np.array([-body.low[1], body.high[0], body.high[2]])
    outline = np.stack([-body.outline[:, 1], body.outline[:, 0]], axis=1)
    return _make_features(low, high, outline, rotate_quarter_turn(body.heights))


def _make_features(low: Vector3, high: Vector3, outline: Points2, heights: HeightMap) -> BodyFeatures:
    return BodyFeatures(
        low, high, outline, compute_column_center(heights), heights, find_cavity(heights), find_flat_cells(heights)
    )


def compute_outline(points: Points2) -> Points2:
    """Compute the convex outline, counter-clockwise; the box where the points lie on a line.

    Only the extreme points in 64 directions are kept: those of a fine curve, within a tenth of a millimetre.
    """
    hull = compute_convex_outline(points, margin=0.0)
    return hull[np.unique(np.argmax(_OUTLINE_DIRECTIONS @ hull.T, axis=1))]


def relation_holds(relation: Relation, x: BodyFeatures, y: BodyFeatures) -> bool:
    """Whether `x` stands in this relation to `y`."""
    return is_beside(x, y, *SIDES[relation]) if relation in SIDES else _HOLDS[relation](x, y)


def relation_nearly_holds(relation: Relation, x: BodyFeatures, y: BodyFeatures) -> bool:
    """Whether the relation could be said to hold: `relation_holds`, or on that side at all, or not quite beside."""
    if relation in SIDES:
        axis, sign = SIDES[relation]
        edge = y.high[axis] if sign > 0 else -y.low[axis]
        return bool(sign * _box_middle_xy(x)[axis] > edge) or relation_holds(relation, x, y)
    if relation is Relation.NEXT_TO:
        return _measure_box_gap(x, y) <= 2 * NEXT_TO_GAP_M and measure_outline_gap(x, y) <= 2 * NEXT_TO_GAP_M
    if relation is Relation.ON:
        return _touches_from_above(x, y) or is_inside(x, y)
    if relation in (Relation.IN, Relation.INTO, Relation.INSIDE):
        return is_inside(x, y) or is_on(x, y)
    return relation_holds(relation, x, y)


def is_inside(x: BodyFeatures, y: BodyFeatures, share: float = _INSIDE_SHARE) -> bool:
    """Whether `x` reaches into the cavity of `y`, with `share` of what is below the rim within its opening.

    Columns whose middle is under the vessel are not in it, even where a tilted rim reaches around them.
    """
    if y.cavity is None:
        return False
    depth = y.cavity.rim_z - x.low[2]
    if depth < min(SUBMERGED_M, 0.5 * float(x.high[2] - x.low[2])) or x.low[2] < y.low[2] - CONTACT_GAP_M:
        return False
    below = x.heights.bottom < y.cavity.rim_z - 0.001
    room = x.heights.window(y.heights, y.cavity.opening, False)
    floor = x.heights.window(y.heights, np.where(y.heights.filled, y.heights.top, -_FAR_M), -_FAR_M)
    over = floor - x.heights.bottom <= x.heights.top - floor
    within = below & room & over
    return bool(below.any()) and bool(within.sum() >= share * below.sum())


def is_on(x: BodyFeatures, y: BodyFeatures) -> bool:
    """Whether `x` rests on `y` from above with its middle over it, and is not inside it."""
    return _touches_from_above(x, y) and not is_inside(x, y)


def is_next_to(x: BodyFeatures, y: BodyFeatures) -> bool:
    """Whether the outlines are less than `NEXT_TO_GAP_M` apart at a common height, neither on nor in the other."""
    level = bool(min(x.high[2], y.high[2]) > max(x.low[2], y.low[2]))
    return level and _measure_box_gap(x, y) <= NEXT_TO_GAP_M and 0.0 < measure_outline_gap(x, y) <= NEXT_TO_GAP_M


def is_beside(x: BodyFeatures, y: BodyFeatures, axis: int, sign: int) -> bool:
    """Whether `x` lies beyond `y` along an axis: boxes apart along it, and that axis the longer way between them."""
    gap = y.low[axis] - x.high[axis] if sign < 0 else x.low[axis] - y.high[axis]
    between = np.abs(_box_middle_xy(x) - _box_middle_xy(y))
    return bool(gap >= -SIDE_OVERLAP_M and between[axis] > 0.0 and between[1 - axis] <= between[axis])


def _measure_box_gap(x: BodyFeatures, y: BodyFeatures) -> float:
    """Measure the horizontal distance between the boxes [m]: a quick lower bound of that of the outlines."""
    apart = np.maximum(x.low - y.high, y.low - x.high)[:2]
    return float(np.linalg.norm(np.maximum(apart, 0.0)))


def measure_outline_gap(x: BodyFeatures, y: BodyFeatures) -> float:
    """Measure the horizontal distance between the convex outlines [m]; 0 where they overlap."""
    a, b = x.outline, y.outline
    if not _separable(a, b):
        return 0.0
    return min(_measure_corner_to_edge(a, b), _measure_corner_to_edge(b, a))


def rests_on(x: BodyFeatures, y: BodyFeatures) -> bool:
    """Whether `x` touches `y` from above anywhere, so that lifting `y` would disturb `x`."""
    clearance = x.heights.bottom - x.heights.window(y.heights, y.heights.top, -np.inf)
    return bool((np.abs(clearance) <= CONTACT_GAP_M).any()) and bool(x.center[2] > y.low[2])


def _touches_from_above(x: BodyFeatures, y: BodyFeatures) -> bool:
    clearance = x.heights.bottom - x.heights.window(y.heights, y.heights.top, -np.inf)
    least = float(clearance[x.heights.filled].min())
    if not abs(least) <= CONTACT_GAP_M or x.center[2] <= y.center[2]:
        return False
    i, j = (int(np.floor(x.center[k] / x.heights.cell)) - y.heights.corner[k] for k in range(2))
    nx, ny = y.heights.top.shape
    return 0 <= i < nx and 0 <= j < ny and bool(ndimage.binary_fill_holes(y.heights.filled)[i, j])


def _box_middle_xy(body: BodyFeatures) -> Vector3:
    return ((body.low + body.high) / 2)[:2]


def _separable(a: Points2, b: Points2) -> bool:
    """Whether a line along an edge of either convex outline separates them (separating axis theorem)."""
    for corners in (a, b):
        edges = np.roll(corners, -1, axis=0) - corners
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
        on_a, on_b = a @ normals.T, b @ normals.T
        if ((on_a.max(axis=0) < on_b.min(axis=0)) | (on_b.max(axis=0) < on_a.min(axis=0))).any():
            return True
    return False


def _measure_corner_to_edge(corners: Points2, outline: Points2) -> float:
    start = outline[None]
    edge = np.roll(outline, -1, axis=0)[None] - start
    to_corner = corners[:, None] - start
    along = np.einsum("ijk,ijk->ij", to_corner, np.broadcast_to(edge, to_corner.shape))
    share = np.clip(along / np.maximum((edge**2).sum(axis=2), 1e-18), 0.0, 1.0)
    return float(np.sqrt(((to_corner - share[..., None] * edge) ** 2).sum(axis=2)).min())


_HOLDS: dict[Relation, Callable[[BodyFeatures, BodyFeatures], bool]] = {
    Relation.ON: is_on,
    Relation.IN: is_inside,
    Relation.INTO: is_inside,
    Relation.INSIDE: is_inside,
    Relation.OUTSIDE: lambda x, y: not is_inside(x, y),
    Relation.NEXT_TO: is_next_to,
}
