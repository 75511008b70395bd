"""Refits of the table to where a detector or a segmenter has seen it."""

import numpy as np

from schemas.geometry import Mask
from schemas.outcome import Dropped
from tableverse_factory.stages.perceive.base.interfaces import PixelBox
from tableverse_factory.stages.perceive.base.table_view import TableView
from tableverse_factory.stages.perceive.table import MIN_TABLE_TOP_PIXELS, find_table

MIN_SEEN_SHARE = 0.35  # of the table that is seen on the plane that was found: objects may hide the rest


def refit_table_to_mask(view: TableView, table_top: Mask, rng: np.random.Generator) -> TableView:
    """Refit the table to the pixels that a segmenter gives to the table-top, so that no larger floor is taken for it.

    Unchanged where too few of them were measured, or they lie on no plane that a table can have.
    """
    found = find_table(view.observation, rng, table_top)
    return view if isinstance(found, Dropped) else found


def refit_table_to_box(view: TableView, box: PixelBox, rng: np.random.Generator) -> TableView:
    """Refit the table to a higher plane that fills more of the box in which a detector sees the table.

    Unchanged where the found table fills enough of the box (objects hide the rest), or no higher plane fills more of
    it: a floor may be taken for a table, never the reverse.
    """
    x0, y0, x1, y1 = (max(round(edge), 0) for edge in box)
    inside = np.zeros(view.valid.shape, dtype=bool)
    inside[y0:y1, x0:x1] = view.valid[y0:y1, x0:x1]
    if not misses_table(view, inside):
        return view
    found = find_table(view.observation, rng, inside)
    if isinstance(found, Dropped) or found.plane.offset <= view.plane.offset:
        return view
    return found if _measure_table_share(found, inside) > _measure_table_share(view, inside) else view


def misses_table(view: TableView, seen: Mask) -> bool:
    """Whether the found table misses most of where a detector has `seen` it, of which enough was measured."""
    inside = seen & view.valid
    return int(inside.sum()) >= MIN_TABLE_TOP_PIXELS and _measure_table_share(view, inside) < MIN_SEEN_SHARE


def _measure_table_share(view: TableView, inside: Mask) -> float:
    return float(view.on_plane[inside].mean()) if inside.any() else 0.0
