"""Pictures side by side or one below the other."""

from collections.abc import Sequence

import numpy as np

from schemas.geometry import Picture

GUTTER = 6
"""White between two panels [pixels]."""


def joined(panels: Sequence[Picture], axis: int) -> Picture:
    """Panels of one size across `axis`, one after the other along it (0 down, 1 to the right), with gutters."""
    shape = list(panels[0].shape)
    shape[axis] = GUTTER
    gutter = np.full(shape, 255, dtype=np.uint8)
    one: Picture = np.concatenate([part for panel in panels for part in (gutter, panel)][1:], axis=axis)
    return one
