"""Texture atlases: every face of a mesh gets its own half of a square cell of a picture.

Cells are powers of two wide and laid out largest first along a Z-order curve, so they tile the picture without
overlap and without a search. A cell holds two faces, one in each half; the texels on the diagonal between the halves
belong to the first, so that filtering at its long side finds no foreign colour.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from schemas.geometry import Frozen, Points, TriangleMesh

MIN_CELL = 4
MAX_CELL = 256
_COARSER = 2.0**0.25


@dataclass(frozen=True, slots=True, eq=False)
class Atlas(Frozen):
    """Where the faces of a mesh lie in a picture.

    Attributes:
        width: Of the picture [px], a power of two.
        height: Of the picture [px], `width` or half of it.
        corner_uv: Points of the picture at each face's corners, 0–1, v upwards. Shape (m, 3, 2).
        texels: Index of every used texel in the flattened picture. Shape (k,).
        faces: The face that each of them shows. Shape (k,).
        weights: Barycentric weights of the face's corners at its centre. Shape (k, 3).
    """

    width: int
    height: int
    corner_uv: Float64[np.ndarray, "m 3 2"]
    texels: Int64[np.ndarray, " k"]
    faces: Int64[np.ndarray, " k"]
    weights: Float64[np.ndarray, "k 3"]


def atlas_of(mesh: TriangleMesh, texel_m: float, max_side: int) -> Atlas:
    """An atlas with texels of about `texel_m` [m], or coarser where the picture would be wider than `max_side`.

    Raises:
        ValueError: if the mesh has more faces than the smallest cells of such a picture can hold.
    """
    corners = mesh.vertices[mesh.faces]
    apex, legs = _apex(corners)
    while True:
        cells = _cells(legs / texel_m)
        order = np.argsort(-cells, kind="stable")
        area = _first_texels(cells[order])
        if area[1] <= max_side * max_side:
            break
        if int(cells.max()) == MIN_CELL:
            raise ValueError(f"{len(cells)} faces do not fit a texture {max_side} px wide")
        texel_m *= _COARSER
    side = 1 << max(0, int(np.ceil(np.log2(area[1]))) + 1) // 2
    height = side // 2 if area[1] <= side * side // 2 else side
    return _laid_out(order, cells[order], area[0], apex[order], side, height)


def texel_points(atlas: Atlas, mesh: TriangleMesh) -> Points:
    """Position of each used texel on the surface, in the mesh's frame [m]. Shape (k, 3)."""
    points: Points = np.einsum("kc,kcd->kd", atlas.weights, mesh.vertices[mesh.faces[atlas.faces]])
    return points


def _apex(corners: Float64[np.ndarray, "m 3 3"]) -> tuple[np.ndarray, np.ndarray]:
    """The corner opposite to each face's longest side, and the longer of the two other sides [m]."""
    opposite = np.linalg.norm(corners[:, [1, 2, 0]] - corners[:, [2, 0, 1]], axis=2)
    apex = np.argmax(opposite, axis=1)
    return apex, np.sort(opposite, axis=1)[:, 1]


def _cells(legs_px: np.ndarray) -> np.ndarray:
    wide = np.clip(legs_px, MIN_CELL, MAX_CELL)
    cells: np.ndarray = (1 << np.ceil(np.log2(wide) - 1e-9).astype(np.int64)).astype(np.int64)
    return cells


def _first_texels(cells: np.ndarray) -> tuple[np.ndarray, int]:
    """Where each face's cell starts on the Z-order curve, and the length of the curve; `cells` is descending."""
    starts, used = np.empty(len(cells), dtype=np.int64), 0
    for size in np.unique(cells)[::-1]:
        here = np.flatnonzero(cells == size)
        starts[here] = used + np.arange(len(here)) // 2 * size**2
        used += (len(here) + 1) // 2 * int(size) ** 2
    return starts, used


def _laid_out(
    order: np.ndarray, cells: np.ndarray, starts: np.ndarray, apex: np.ndarray, width: int, height: int
) -> Atlas:
    x, y = _deinterleaved(starts)
    # The second face of a cell starts where the one before it does.
    second = np.concatenate([[False], starts[1:] == starts[:-1]])
    uv = np.empty((len(order), 3, 2))
    texels, faces, weights = [], [], []
    for size in np.unique(cells)[::-1]:
        for flipped in (False, True):
            here = np.flatnonzero((cells == size) & (second == flipped))
            template = _half(int(size), flipped)
            uv[order[here]] = _turned(_corners(int(size), flipped)[None] + np.stack([x, y], 1)[here, None], apex[here])
            columns, rows = x[here, None] + template[0], y[here, None] + template[1]
            texels.append((rows * width + columns).ravel())
            faces.append(np.repeat(order[here], len(template[0])))
            local = np.broadcast_to(template[2], (len(here), *template[2].shape))
            weights.append(_turned(local.transpose(0, 2, 1), apex[here]).transpose(0, 2, 1).reshape(-1, 3))
    uv = uv / [width, height]
    uv[..., 1] = 1.0 - uv[..., 1]
    return Atlas(width, height, uv, np.concatenate(texels), np.concatenate(faces), np.concatenate(weights))


def _half(size: int, flipped: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns, rows and barycentric weights of one half of a cell; the apex is the cell's corner."""
    row, column = np.indices((size, size)).reshape(2, -1)
    mine = row + column >= size if flipped else row + column < size
    row, column = row[mine], column[mine]
    along = np.stack([size - 1 - column, size - 1 - row] if flipped else [column, row], axis=1) / (size - 2)
    along = along / np.maximum(along.sum(axis=1, keepdims=True), 1.0)
    return column, row, np.concatenate([1.0 - along.sum(axis=1, keepdims=True), along], axis=1)


def _corners(size: int, flipped: bool) -> Float64[np.ndarray, "3 2"]:
    """Texel centres of the half's corners within its cell [px]: the apex, along the row, along the column."""
    near, far = (size - 0.5, 1.5) if flipped else (0.5, size - 1.5)
    return np.array([[near, near], [far, near], [near, far]])


def _turned(of_apex: np.ndarray, apex: np.ndarray) -> np.ndarray:
    """Values per corner, counted from the apex, in the order of the face's own corners (axis 1)."""
    index = (np.arange(3)[None] - apex[:, None]) % 3
    return np.take_along_axis(of_apex, index.reshape(*index.shape, *[1] * (of_apex.ndim - 2)), axis=1)


def _deinterleaved(code: Int64[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """Column and row of a place on the Z-order curve."""
    column, row = np.zeros_like(code), np.zeros_like(code)
    for bit in range(16):
        column |= (code >> (2 * bit) & 1) << bit
        row |= (code >> (2 * bit + 1) & 1) << bit
    return column, row
