"""Layouts of boards and tiles on the square: in rows, or as herringbone."""

from dataclasses import dataclass

import numpy as np

from schemas.geometry import Frozen
from tableverse_factory.sources.textures.fields import Field, Ids, pixel_grid


@dataclass(frozen=True, slots=True, eq=False)
class BoardLayout(Frozen):
    """Board of each pixel, its place along and across it, 0–1, and the distance to its edge, over the square's side."""

    ids: Ids
    count: int
    along: Field
    across: Field
    edge: Field
    upright: np.ndarray


def lay_rows(size: int, down: int, right: int, offsets: np.ndarray) -> BoardLayout:
    """Lay boards of one length in rows, each row moved by its offset [boards]. `offsets` has shape (down,)."""
    u, v = pixel_grid(size)
    y = v * down
    row = np.minimum(y.astype(np.int32), down - 1)
    x = u * right + offsets.astype(np.float32)[row]
    column = np.floor(x)
    along, across = x - column, y - row
    ids = row * right + column.astype(np.int32) % right
    edge = np.minimum(np.minimum(along, 1 - along) / right, np.minimum(across, 1 - across) / down)
    return BoardLayout(ids, down * right, along, across, edge, np.zeros((size, size), dtype=bool))


def lay_herringbone(size: int, repeats: int, length: int) -> BoardLayout:
    """Lay boards `length` times as long as wide at right angles, in steps of one width.

    In units of a board's width, the cell (i, j) belongs to a lying board if (i + j) mod 2·length < length, else to a
    standing one; the pattern repeats every 2·length cells.
    """
    u, v = pixel_grid(size)
    period = 2 * length
    n = period * repeats
    x, y = u * n, v * n
    i, j = (np.minimum(t.astype(np.int32), n - 1) for t in (x, y))
    phase = (i - j) % period
    upright = phase >= length
    start = np.where(upright, (j - (period - 1 - phase)) % n, (i - phase) % n)
    inside_x, inside_y = x - i, y - j
    along = np.where(upright, (period - 1 - phase) + inside_y, phase + inside_x) / length
    across = np.where(upright, inside_x, inside_y)
    ids = np.where(upright, n * n + i * n + start, j * n + start)
    edge = np.minimum(np.minimum(along, 1 - along) * length, np.minimum(across, 1 - across)) / n
    used = np.bincount(ids.ravel(), minlength=2 * n * n) > 0
    dense = (np.cumsum(used) - 1).astype(np.int32)
    return BoardLayout(dense[ids], int(used.sum()), along.astype(np.float32), across, edge.astype(np.float32), upright)
