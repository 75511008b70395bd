"""Height maps: a body seen from above and from below, on a grid that all bodies of a scene share.

For placement: how low a body can be dropped, what it then rests on, and where a vessel has room. A cell is as high as
its highest ray, vertex or sharp edge: a rim thinner than a cell closes, but perhaps not a sharp one of slanted walls.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy import ndimage
from skimage.morphology import reconstruction

from schemas.geometry import Frozen, Points, TriangleMesh, Vector3
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.raycasting import RaycastingScene, pack_rays

Heights = Float64[np.ndarray, "nx ny"]
CellMask = Bool[np.ndarray, "nx ny"]

CELL_M = 0.003  # spacing of the grid: the walls of household vessels are 2 to 5 mm
MIN_CAVITY_DEPTH_M = 0.015
MIN_CAVITY_WIDTH_M = 0.025
MIN_CAVITY_ASPECT = 0.12  # depth over width: a plate of 25 cm with a rim of 2 cm is no container, a frying pan is one
LEVEL_TOLERANCE_M = 0.0025
MIN_FLAT_WIDTH_M = 0.04  # a body carries others on a level patch of at least this diameter
_RAYS_PER_SIDE = 2
_MIN_WATER_DEPTH_M = 0.003
_MAX_STEEP_SINE = 0.35  # faces of normals that rise no more are upright: rays 1.5 mm apart miss the rim between them


@dataclass(frozen=True, slots=True, eq=False)
class HeightMap(Frozen):
    """Highest and lowest point of a body over each cell (nx, ny) [m]; -inf and +inf where the body is not.

    Cell (i, j) spans `[(i, j), (i + 1, j + 1)] * cell`; `corner` is the (i, j) of element (0, 0).
    """

    cell: float
    corner: tuple[int, int]
    top: Heights
    bottom: Heights

    @property
    def filled(self) -> CellMask:
        """Cells that the body covers."""
        return np.isfinite(self.top)

    def shifted(self, cells: tuple[int, int], rise: float) -> "HeightMap":
        """Move the map by whole cells and lift it by `rise` [m]."""
        moved = replace(self, corner=(self.corner[0] + cells[0], self.corner[1] + cells[1]))
        return moved if rise == 0.0 else replace(moved, top=self.top + rise, bottom=self.bottom + rise)

    def window(self, other: "HeightMap", values: np.ndarray, outside: float | bool) -> np.ndarray:
        """Bring `values` on `other`'s cells to the cells of this map; `outside` where `other` has none."""
        result = np.full(self.top.shape, outside, dtype=values.dtype)
        di, dj = other.corner[0] - self.corner[0], other.corner[1] - self.corner[1]
        i0, i1 = max(di, 0), min(di + values.shape[0], self.top.shape[0])
        j0, j1 = max(dj, 0), min(dj + values.shape[1], self.top.shape[1])
        if i0 < i1 and j0 < j1:
            result[i0:i1, j0:j1] = values[i0 - di : i1 - di, j0 - dj : j1 - dj]
        return result


@dataclass(frozen=True, slots=True, eq=False)
class Cavity(Frozen):
    """Room in a vessel that opens upwards, as water would fill it up to `rim_z`, where it would spill [m].

    `cells` are the water's surface on the vessel's own map; `opening` is wider by one cell: contents may touch walls.
    """

    cells: CellMask
    opening: CellMask
    rim_z: float
    floor_z: float
    volume_m3: float

    @property
    def depth(self) -> float:
        """From rim to floor [m]."""
        return self.rim_z - self.floor_z


def compute_height_map(mesh: TriangleMesh, caster: RaycastingScene, cell: float = CELL_M) -> HeightMap:
    """Compute the map of a mesh, which `caster` holds."""
    low, high = aabb(mesh.vertices)
    first = np.floor(low[:2] / cell).astype(int)
    shape = np.maximum(np.ceil(high[:2] / cell).astype(int) - first, 1)
    steps = [(first[k] + (np.arange(shape[k] * _RAYS_PER_SIDE) + 0.5) / _RAYS_PER_SIDE) * cell for k in range(2)]
    top = high[2] + 0.01 - _cast_columns(caster, steps, high[2] + 0.01, -1.0)
    bottom = low[2] - 0.01 + _cast_columns(caster, steps, low[2] - 0.01, 1.0)
    blocks = (shape[0], _RAYS_PER_SIDE, shape[1], _RAYS_PER_SIDE)
    top, bottom = top.reshape(blocks).max(axis=(1, 3)), bottom.reshape(blocks).min(axis=(1, 3))
    _add_edges(mesh, first, cell, top, bottom)
    return HeightMap(cell, (int(first[0]), int(first[1])), top, bottom)


def _cast_columns(caster: RaycastingScene, steps: list[np.ndarray], from_z: float, direction: float) -> np.ndarray:
    """Measure along vertical rays from the plane `from_z` to the mesh, inf where they miss."""
    origins = np.stack(np.meshgrid(*steps, from_z, indexing="ij"), axis=-1)[:, :, 0]
    rays = pack_rays(origins, np.array([0.0, 0.0, direction]))
    return caster.cast_rays(rays, nthreads=1)["t_hit"].numpy().astype(np.float64)


def _add_edges(mesh: TriangleMesh, first: np.ndarray, cell: float, top: Heights, bottom: Heights) -> None:
    """Raise and lower cells to the vertices and sharp edges in them: thin rims and spikes that fall between rays."""
    at = np.column_stack([mesh.vertices[:, :2] / cell - first, mesh.vertices[:, 2]])
    _add_points(at[:, :2], at[:, 2], top, bottom)
    edges = _find_sharp_edges(mesh.vertices, mesh.faces)
    start, end = at[edges[:, 0]], at[edges[:, 1]]
    edge, share = _split_at_grid_lines(start[:, :2], end[:, :2])
    same = edge[1:] == edge[:-1]
    edge, before, after = edge[1:][same], share[:-1][same], share[1:][same]
    start, way = start[edge], (end - start)[edge]
    middle = start[:, :2] + ((before + after) / 2)[:, None] * way[:, :2]
    for at_share in (before, after):
        _add_points(middle, start[:, 2] + at_share * way[:, 2], top, bottom)


def _find_sharp_edges(vertices: Points, faces: np.ndarray) -> Int64[np.ndarray, "n 2"]:
    """Find edges across which a surface turns from level to steep or downwards, or ends; rays see the rest."""
    columns = np.ascontiguousarray(vertices.T)
    start = columns[:, faces[:, 0]]
    (ax, ay, az), (bx, by, bz) = columns[:, faces[:, 1]] - start, columns[:, faces[:, 2]] - start
    across = (ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2
    up = ax * by - ay * bx
    facing = np.sign(up) * (up**2 > _MAX_STEEP_SINE**2 * (across + up**2))
    either = _find_sharp_vertices(facing, faces, len(vertices))
    a, b, c = (either[faces[:, k]] for k in range(3))
    near = np.flatnonzero((a & b) | (b & c) | (c & a))
    ends = np.sort(faces[near][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    key, facing = ends[:, 0] * len(vertices) + ends[:, 1], np.repeat(facing[near], 3)
    between = either[ends[:, 0]] & either[ends[:, 1]]
    key, facing = key[between], facing[between]
    order = np.argsort(key, kind="stable")
    key, facing = key[order], facing[order]
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    turns = np.minimum.reduceat(facing, starts) != np.maximum.reduceat(facing, starts)
    ends_here = np.diff(starts, append=len(key)) == 1
    chosen = key[starts[turns | ends_here]]
    return np.column_stack([chosen // len(vertices), chosen % len(vertices)])


def _find_sharp_vertices(facing: np.ndarray, faces: np.ndarray, count: int) -> Bool[np.ndarray, " n"]:
    """Find vertices at which faces of two kinds meet, or a surface may end: few, as sorting all edges is slow."""
    ways = np.zeros(count, dtype=np.int8)
    for way in (-1, 0, 1):
        seen = np.zeros(count, dtype=bool)
        seen[faces[facing == way]] = True
        ways += seen
    # Where each edge has its reverse, sums of random numbers over a vertex's edges out and in are equal; where not,
    # they differ almost surely.
    number = np.random.default_rng(0).integers(2**32, size=count).astype(np.float64)
    a, b, c = faces.T
    out, back = np.concatenate([a, b, c]), np.concatenate([b, c, a])
    gained, lost = np.bincount(out, number[back], count), np.bincount(back, number[out], count)
    return (ways > 1) | (gained != lost)


def _split_at_grid_lines(
    start: np.ndarray, end: np.ndarray
) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Split edges (m, 2), in cells, where they cross grid lines: edge and share of its length, ends included."""
    every = np.arange(len(start))
    edges, shares = [every, every], [np.zeros(len(start)), np.ones(len(start))]
    for k in range(2):
        low, high = np.minimum(start[:, k], end[:, k]), np.maximum(start[:, k], end[:, k])
        counts = np.maximum(np.ceil(high) - np.floor(low) - 1.0, 0.0).astype(np.int64)
        edge = np.repeat(every, counts)
        line = np.floor(low)[edge] + 1.0 + np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
        edges.append(edge)
        shares.append((line - start[edge, k]) / (end[edge, k] - start[edge, k]))
    edge, share = np.concatenate(edges), np.concatenate(shares)
    order = np.lexsort((share, edge))
    return edge[order], share[order]


def _add_points(at: np.ndarray, height: np.ndarray, top: Heights, bottom: Heights) -> None:
    """Raise and lower cells to points, given in cells, of these heights [m]."""
    index = np.clip(np.floor(at).astype(np.int64), 0, np.array(top.shape) - 1)
    np.maximum.at(top, (index[:, 0], index[:, 1]), height)
    np.minimum.at(bottom, (index[:, 0], index[:, 1]), height)


def find_cavity(body: HeightMap) -> Cavity | None:
    """Find the largest pool that forms when water is poured over the body, if it is large enough for a vessel.

    Flooding by morphological reconstruction (Vincent 1993); a rim broken by one cell counts as whole.
    """
    dry = float(body.bottom[body.filled].min()) - 1.0
    ground = np.pad(np.where(body.filled, body.top, dry), 2, constant_values=dry)
    ground = np.maximum(ground, ndimage.grey_closing(ground, size=(3, 3)))
    # Water runs off the edge and through holes.
    seed = np.where(ground > dry + 0.5, ground.max(), dry)
    depth = (reconstruction(seed, ground, method="erosion") - ground)[2:-2, 2:-2]
    labels, count = ndimage.label(depth > _MIN_WATER_DEPTH_M)
    if count == 0:
        return None
    volumes = ndimage.sum_labels(depth, labels, index=np.arange(1, count + 1)) * body.cell**2
    best = int(np.argmax(volumes)) + 1
    cells = labels == best
    rim_z = float((body.top + depth)[cells].max())
    opening = ndimage.binary_dilation(cells, np.ones((3, 3), dtype=bool))
    cavity = Cavity(cells, opening, rim_z, rim_z - float(depth[cells].max()), float(volumes[best - 1]))
    width = measure_inscribed_width(cells, body.cell)
    enough = max(MIN_CAVITY_DEPTH_M, MIN_CAVITY_ASPECT * width)
    return cavity if width >= MIN_CAVITY_WIDTH_M and cavity.depth >= enough else None


def find_flat_cells(body: HeightMap) -> CellMask:
    """Find cells around which the top is level, without those where no disc of `MIN_FLAT_WIDTH_M` fits."""
    top = np.where(body.filled, body.top, -1e3)
    span = ndimage.maximum_filter(top, 3, mode="nearest") - ndimage.minimum_filter(top, 3, mode="nearest")
    labels, count = ndimage.label(body.filled & (span <= LEVEL_TOLERANCE_M))
    flat = np.zeros(top.shape, dtype=bool)
    for value, box in enumerate(ndimage.find_objects(labels, count), start=1):
        cells = labels[box] == value
        # The outermost cells of a level top are not level themselves: the disc grows back by one.
        least = MIN_FLAT_WIDTH_M - 2 * body.cell
        if (min(cells.shape) + 1) * body.cell >= least and measure_inscribed_width(cells, body.cell) >= least:
            flat[box] |= cells
    return flat


def rotate_quarter_turn(body: HeightMap) -> HeightMap:
    """Rotate the map by 90° about the z axis of the table frame."""
    # (x, y) goes to (-y, x): column j becomes row -1 - j.
    corner = (-body.corner[1] - body.top.shape[1], body.corner[0])
    top, bottom = (np.ascontiguousarray(values.T[::-1]) for values in (body.top, body.bottom))
    return HeightMap(body.cell, corner, top, bottom)


def measure_inscribed_width(cells: CellMask, cell: float) -> float:
    """Measure the diameter of the largest disc in the cells [m]."""
    return float(2 * ndimage.distance_transform_edt(np.pad(cells, 1)).max() * cell)


def compute_column_center(body: HeightMap) -> Vector3:
    """Compute the centre of the columns between bottom and top [m]: of the volume, without holes and overhangs."""
    i, j = np.nonzero(body.filled)
    top, bottom = body.top[i, j], body.bottom[i, j]
    weight = np.maximum(top - bottom, 1e-4)
    x, y = (body.corner[0] + i + 0.5) * body.cell, (body.corner[1] + j + 0.5) * body.cell
    return np.array([x, y, (top + bottom) / 2]) @ weight / weight.sum()
