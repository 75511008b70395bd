"""Tables of floats that the tracer reads: meshes with a bounding volume hierarchy each."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int32

from schemas.geometry import Frozen
from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.training.picture.pool import MeshPool
from tableverse_factory.evaluation.training.picture.shapes import Mesh, make_shapes

TABLE_TOP, TABLE_SIDE = 255, 254  # ids of the table's upper face and of its edge; things have 1-253, the rest has 0
LEAF = 4  # most triangles of a leaf
MAX_TRIANGLES = 1 << 24  # whose numbers a float holds
CREASE = 0.82  # cosine between a face and its neighbours, below which an edge is sharp

Mapper = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class MeshTables(Frozen):
    """Triangles of all meshes, each mesh under its own tree.

    Attributes:
        nodes: Box, first child or first triangle, number of triangles (0 for an inner node). Shape (n, 8).
        triangles: Corner and two edges. Shape (t, 9).
        normals: Of the corners. Shape (t, 9).
        roots: First node of each mesh. Shape (m,).
        ends: Past the last triangle of each mesh. Shape (m,).
        low, high: Corners of each mesh's box [m]. Shape (m, 3).
        shiny: 0 for matt to 1 for polished. Shape (m,).
        hollow: Whether it is an open vessel. Shape (m,).
        kinds: Name of each shape's kind; `pool` for the generator's meshes.
        settled: Indices of meshes and poses at rest, one array of shape (k, 8) per arrangement.
    """

    nodes: Float32[np.ndarray, "n 8"]
    triangles: Float32[np.ndarray, "t 9"]
    normals: Float32[np.ndarray, "t 9"]
    roots: Int32[np.ndarray, " m"]
    ends: Int32[np.ndarray, " m"]
    low: Float64[np.ndarray, "m 3"]
    high: Float64[np.ndarray, "m 3"]
    shiny: Float64[np.ndarray, " m"]
    hollow: np.ndarray
    kinds: tuple[str, ...]
    settled: tuple[Float64[np.ndarray, "k 8"], ...]

    def drop_triangles(self) -> "MeshTables":
        """Return what scenes are made from, without what only a renderer reads."""
        return replace(self, nodes=self.nodes[:0], triangles=self.triangles[:0], normals=self.normals[:0])

    def get_triangles(self, root: int) -> Float64[np.ndarray, "k 3 3"]:
        """Return the corners of the triangles of the mesh with this first node [m]."""
        index = int(np.searchsorted(self.roots, root))
        rows = self.triangles[self.ends[index - 1] if index else 0 : self.ends[index]].astype(np.float64)
        return np.stack([rows[:, :3], rows[:, :3] + rows[:, 3:6], rows[:, :3] + rows[:, 6:]], axis=1)

    def find(self, *kinds: str) -> list[int]:
        """List the meshes of these kinds."""
        return [index for index, kind in enumerate(self.kinds) if kind in kinds]


def make_tables(pool: MeshPool, seed: int, mapper: Mapper = map) -> MeshTables:
    """Build the trees of the pool's meshes and of the shapes."""
    shapes = list(make_shapes(seed))
    meshes = [pool.get_mesh(index) for index in range(len(pool))] + [mesh for _, mesh in shapes]
    nodes, triangles, normals, roots = [], [], [], []
    node_count = triangle_count = 0
    for tree, order, smooth, (vertices, faces) in mapper(_build, meshes):
        tree = tree.copy()
        leaf = tree[:, 7] > 0
        tree[leaf, 6] += triangle_count
        tree[~leaf, 6] += node_count
        corners = vertices[faces[order]]
        edges = corners[:, 1:] - corners[:, :1]
        triangles.append(np.concatenate([corners[:, :1], edges], axis=1).reshape(-1, 9).astype(np.float32))
        normals.append(smooth[order].reshape(-1, 9))
        nodes.append(tree)
        roots.append(node_count)
        node_count, triangle_count = node_count + len(tree), triangle_count + len(faces)
    if triangle_count > MAX_TRIANGLES:
        raise InputError(f"the meshes have {triangle_count} triangles, at most {MAX_TRIANGLES}: take fewer scenes")
    extra = len(shapes)
    own = np.arange(len(pool))
    rows = np.column_stack([own, pool.poses]).astype(np.float64)
    return MeshTables(
        nodes=np.concatenate(nodes),
        triangles=np.concatenate(triangles),
        normals=np.concatenate(normals),
        roots=np.array(roots, dtype=np.int32),
        ends=np.cumsum([len(each) for each in triangles]).astype(np.int32),
        low=np.array([vertices.min(axis=0) for vertices, _ in meshes]),
        high=np.array([vertices.max(axis=0) for vertices, _ in meshes]),
        shiny=np.concatenate([pool.shiny / 255.0, np.zeros(extra)]),
        hollow=np.concatenate([pool.hollow > 0, np.zeros(extra, dtype=bool)]),
        kinds=("pool",) * len(pool) + tuple(kind for kind, _ in shapes),
        settled=tuple(rows[pool.scene == scene] for scene in np.unique(pool.scene)),
    )


def _build(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray, Mesh]:
    vertices, faces = mesh
    tree, order = build_tree(vertices[faces])
    return tree, order, smooth_normals(vertices, faces), mesh


def build_tree(
    corners: Float64[np.ndarray, "k 3 3"],
) -> tuple[Float32[np.ndarray, "n 8"], Int32[np.ndarray, " k"]]:
    """Build a complete binary tree by medians, a level at a time; return its nodes and the order of triangles."""
    centers = (corners.min(axis=1) + corners.max(axis=1)) / 2
    levels = max(0, int(np.ceil(np.log2(max(1.0, len(corners) / LEAF)))))
    order = np.arange(len(corners))
    for level in range(levels):
        starts = _split(len(corners), level)
        segment = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        own = centers[order]
        extent = np.maximum.reduceat(own, starts[:-1]) - np.minimum.reduceat(own, starts[:-1])
        key = own[np.arange(len(order)), extent.argmax(axis=1)[segment]]
        order = order[np.lexsort((key, segment))]
    low, high = corners[order].min(axis=1), corners[order].max(axis=1)
    rows = []
    for level in range(levels + 1):
        starts = _split(len(corners), level)
        boxes = [np.minimum.reduceat(low, starts[:-1]) - 1e-6, np.maximum.reduceat(high, starts[:-1]) + 1e-6]
        index = np.arange(len(starts) - 1)
        last = level == levels
        first = starts[:-1] if last else 2 ** (level + 1) - 1 + 2 * index
        count = np.diff(starts) if last else np.zeros(len(index))
        rows.append(np.column_stack([*boxes, first, count]))
    return np.concatenate(rows).astype(np.float32), order.astype(np.int32)


def _split(count: int, level: int) -> Int32[np.ndarray, " s"]:
    """Split `count` items into 2 ** level runs whose halves are those of the next level."""
    starts = np.array([0, count])
    for _ in range(level):
        middles = (starts[:-1] + starts[1:]) // 2
        starts = np.sort(np.concatenate([starts, middles]))
    return starts.astype(np.int32)


def smooth_normals(vertices: Float64[np.ndarray, "n 3"], faces: np.ndarray) -> Float32[np.ndarray, "k 3 3"]:
    """Average the normals of faces that meet at a corner, except over sharp edges."""
    cross = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    flat = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-12)
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-9)
    keys = np.round((vertices - vertices.min(axis=0)) / size * 20000).astype(np.int64)
    _, welded = np.unique(keys @ [1, 32768, 32768**2], return_inverse=True)
    corners = welded[faces]
    summed = np.stack(
        [np.bincount(corners.ravel(), np.repeat(cross[:, axis], 3), welded.max() + 1) for axis in range(3)], axis=1
    )
    mean = summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-12)
    smooth = mean[corners]
    keep = np.einsum("ijk,ik->ij", smooth, flat) > CREASE
    return np.where(keep[..., None], smooth, flat[:, None]).astype(np.float32)


def stack_rows(rows: Sequence[np.ndarray], width: int) -> Float32[np.ndarray, "n w"]:
    """Stack rows of a table; an empty one has one row of zeros, which nothing refers to."""
    return np.array(rows if rows else np.zeros((1, width)), dtype=np.float32)
