"""Collision geoms that no drawn geom represents: a sticker on a box is not the box."""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float64

# A collision geom counts as drawn if drawn geoms reach into this share of its box, in all. The emptiest convex piece
# around 33 scanned meshes is filled to 0.93; a sticker fills almost nothing.
MIN_DRAWN_SHARE = 0.05
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def find_undrawn_geoms(
    model: mujoco.MjModel, data: mujoco.MjData, drawn: Sequence[int], solid: Sequence[int]
) -> list[int]:
    """Find colliding geoms of a body that no geom of its visible shape represents: though unseen, they belong to it.

    `data` holds the positions of the geoms.
    """
    index = np.array(drawn, dtype=int)
    middle, half = np.split(model.geom_aabb[index], 2, axis=1)
    local = middle[:, None] + half[:, None] * _CORNERS  # of each geom's own box
    turn = data.geom_xmat[index].reshape(-1, 3, 3)
    corners = np.einsum("nij,nkj->nki", turn, local) + data.geom_xpos[index][:, None]
    rest = (geom for geom in solid if geom not in drawn)
    return [geom for geom in rest if _measure_filled_share(model, data, geom, corners) < MIN_DRAWN_SHARE]


def _measure_filled_share(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int, corners: Float64[np.ndarray, "n 8 3"]
) -> float:
    """Measure the share of a geom's own box that other boxes fill, summed; 0 for a plane, which is infinite."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
        return 0.0
    local = (corners - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3)
    middle, half = np.split(model.geom_aabb[geom], 2)
    low = np.maximum(local.min(axis=1), middle - half)
    high = np.minimum(local.max(axis=1), middle + half)
    shared = np.prod(np.clip(high - low, 0.0, None), axis=1).sum()
    return float(shared / max(np.prod(2 * half), 1e-18))
