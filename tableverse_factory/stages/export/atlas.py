"""Texture atlas of a mesh: two faces to a square, large faces in large squares."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from schemas.geometry import Frozen, Points, TriangleMesh
from tableverse_factory.geometry.math.aabb import aabb

CELL = 4  # side of the smallest square [texels]
LEVELS = 5  # number of sizes: squares have CELL · 2^k texels along a side, k below this
# Texels between a triangle and its square's border, and of a side lost to borders and the diagonal: filters then mix a
# face with copies of its own edge. The smallest squares, of faces without detail, have no room for it.
INSET, GUTTER = 1, 6
FINE_TEXELS = 1.5  # a face of this size [texels] shows all its detail in the smallest square, with two along an edge


@dataclass(frozen=True, slots=True, eq=False)
class Atlas(Frozen):
    """Places of the faces in a texture of `side` x `side` texels.

    Each face has one half of a square of `square` texels a side, whose first texel is at `corner` (column, row): the
    half away from that texel where `second` is true.
    """

    side: int
    square: Int64[np.ndarray, " m"]
    corner: Int64[np.ndarray, "m 2"]
    second: Bool[np.ndarray, " m"]


def lay_out_atlas(mesh: TriangleMesh, texels_per_metre: Float64[np.ndarray, " m"], side: int) -> Atlas | None:
    """Lay out an atlas at this density of each face; None where the texture is too small.

    Squares are cut by size, the largest first, along a Morton curve of the texture, which packs powers of two without
    a gap; faces of a size follow one another along a Morton curve in space, so that neighbours in the texture, which
    coarse mip levels mix, are neighbours on the object.
    """
    level = _choose_levels(mesh, texels_per_metre)
    pairs = (np.bincount(level, minlength=LEVELS) + 1) // 2
    if int(pairs @ 4 ** np.arange(LEVELS)) > (side // CELL) ** 2:
        return None
    curve = _sort_along_curve(mesh.vertices[mesh.faces].mean(axis=1))
    corner = np.zeros((len(level), 2), dtype=np.int64)
    second = np.zeros(len(level), dtype=bool)
    start = 0
    for k in range(LEVELS - 1, -1, -1):
        faces = curve[level[curve] == k]
        slots = np.arange(len(faces)) // 2
        corner[faces] = CELL * _decode_morton(start + slots * 4**k)
        second[faces] = np.arange(len(faces)) % 2 == 1
        start += pairs[k] * 4**k
    return Atlas(side, CELL << level, corner, second)


def list_triangle_texels(square: int, second: bool) -> tuple[Int64[np.ndarray, "t 2"], Float64[np.ndarray, "t 3"]]:
    """List texels (column, row) of one half of a square, and their weights in its face; the gutter repeats the edge."""
    row, column = np.indices((square, square))
    half = (row + column >= square) == second
    i, j = column[half], row[half]
    inset, reach = _inset_triangle(square)
    one, two = (square - 1 - i, square - 1 - j) if second else (i, j)
    weights = np.stack([reach + 2 * inset - one - two, one - inset, two - inset], axis=-1) / reach
    weights = np.clip(weights, 0.0, None)
    return np.stack([i, j], axis=-1).astype(np.int64), weights / weights.sum(axis=-1, keepdims=True)


def find_corner_texels(atlas: Atlas) -> Int64[np.ndarray, "m 3 2"]:
    """Find the texels (column, row) at each face's three corners."""
    sizes, which = np.unique(atlas.square, return_inverse=True)
    inset, reach = (np.array([_inset_triangle(int(size))[k] for size in sizes])[which, None, None] for k in range(2))
    steps = inset + reach * np.array([[0, 0], [1, 0], [0, 1]])
    last = (atlas.square - 1)[:, None, None]
    return np.asarray(atlas.corner[:, None] + np.where(atlas.second[:, None, None], last - steps, steps))


def _inset_triangle(square: int) -> tuple[int, int]:
    """Return the texels from a square's border to its triangle, and along the triangle's legs."""
    return (INSET, square - GUTTER) if square > CELL else (0, 1)


def _choose_levels(mesh: TriangleMesh, texels_per_metre: Float64[np.ndarray, " m"]) -> Int64[np.ndarray, " m"]:
    """Choose the size of each face's square, as a power of two: by area, and for slivers by half their length."""
    if not texels_per_metre.any():
        return np.zeros(len(mesh.faces), dtype=np.int64)
    corners = mesh.vertices[mesh.faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    inner = np.maximum(np.sqrt(doubled), edges / 2) * texels_per_metre
    wanted = np.where(inner > FINE_TEXELS, inner + GUTTER, CELL)
    return np.asarray(np.clip(np.ceil(np.log2(wanted / CELL)).astype(np.int64), 0, LEVELS - 1))


def _sort_along_curve(points: Points) -> Int64[np.ndarray, " n"]:
    low, high = aabb(points)
    cells = ((points - low) / max(float((high - low).max()), 1e-30) * 1023).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def _decode_morton(code: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, "n 2"]:
    """Decode positions along a Morton curve of the plane to column and row."""
    place = np.zeros((len(code), 2), dtype=np.int64)
    for bit in range(16):
        for axis in range(2):
            place[:, axis] |= (code >> (2 * bit + axis) & 1) << bit
    return place
