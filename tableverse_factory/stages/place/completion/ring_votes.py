"""Votes of an object's free space for the rings about an axis: open or solid, over all azimuths that were seen."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from schemas.geometry import Frozen, Pose
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.stages.place.view.object_view import ObjectView, measure_clearances

AZIMUTHS = 32
CELLS = 4500
CELL_RANGE_M = (0.0007, 0.0025)
HIDDEN_SHARE = 0.3

Field = Float64[np.ndarray, "nr nz"]
Cells = Bool[np.ndarray, "nr nz"]
Profile = Float64[np.ndarray, "n 2"]  # distance from the axis and height along it [m]


@dataclass(frozen=True, slots=True, eq=False)
class RingVotes(Frozen):
    """A field: sample (i, k) lies (i + 1/2) cell from the axis, at the height bottom + (k + 1/2) cell along it."""

    field: Field  # mean signed distance to the surface over the observed azimuths [m], positive inside; else NaN
    hidden: Cells  # by another object
    cell: float  # spacing [m]
    bottom: float  # [m]
    band: float  # clamp of the field [m]


def collect_votes(view: ObjectView, axis: Pose, profile: Profile) -> RingVotes | None:
    """Average the observed free space of each ring over all azimuths."""
    low, top = float(np.quantile(profile[:, 1], 0.002)), float(np.quantile(profile[:, 1], 0.998))
    bottom = min(view.support_z - axis.position[2], top - 0.003) if is_upright(axis) else low
    reach = float(np.quantile(profile[:, 0], 0.998))
    if not 0.002 < reach < 1.0 or top - bottom < 0.002:
        return None
    cell = float(np.clip(np.sqrt(reach * (top - bottom) / CELLS), *CELL_RANGE_M))
    nr, nz = int(np.ceil(reach / cell)) + 4, int(np.ceil((top - bottom) / cell)) + 4
    if nr * nz > 8 * CELLS:
        return None
    r, z = (np.arange(nr) + 0.5) * cell, bottom + (np.arange(nz) + 0.5) * cell
    angle = 2 * np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
    shape = (AZIMUTHS, nr, nz)
    x, y = np.cos(angle)[:, None, None] * r[:, None], np.sin(angle)[:, None, None] * r[:, None]
    rings = np.stack([np.broadcast_to(a, shape) for a in (x, y, z[None, None, :])], axis=-1).reshape(-1, 3)
    clearance, behind, hidden = measure_clearances(view, rings, axis)
    height = rings @ rotation_matrix(axis.quaternion_wxyz)[2] + axis.position[2]
    clearance = np.minimum(clearance, height - view.support_z + cell).reshape(shape)
    band = max(2.0 * cell, 0.0025)
    known = (clearance < 0.0) | (behind.reshape(shape) < band)
    count = known.sum(axis=0)
    total = np.where(known, np.clip(clearance, -band, band), 0.0).sum(axis=0)
    field = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    unseen = (count == 0) & (hidden.reshape(shape).mean(axis=0) > HIDDEN_SHARE)
    return RingVotes(field, unseen, cell, bottom, band)


def is_upright(axis: Pose) -> bool:
    """Whether an axis is vertical, so that the lowest end of what turns about it rests on the support."""
    return bool(axis.quaternion_wxyz[0] > 1.0 - 1e-9)
