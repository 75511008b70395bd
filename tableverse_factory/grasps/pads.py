"""How much of two closing pads finds something to press on: the shape of a body around its contacts, by rays."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from schemas.geometry import Frozen, Points
from schemas.trajectories import Numbers
from tableverse_factory.geometry.grasping import first_hits
from tableverse_factory.geometry.height_maps import Caster

STEP_M = 0.005
_SIDE = 4
"""Steps from the contact to the edge of a map."""

PAD_M2 = 4e-4
"""Area that counts as a full hold: 2 cm by 2 cm."""

SOFT_M = 0.0015
"""Pads press on what lies this far behind the first point that they touch: rubber yields, scans are rough."""

_OUTSIDE_M = 0.012


@dataclass(frozen=True, slots=True, eq=False)
class PadMaps(Frozen):
    """Two maps per pair of contacts, on one grid across the closing axis.

    Attributes:
        right: First direction of the grid, unit. Shape (n, 3).
        down: Second. Shape (n, 3).
        heights: How far the body sticks out towards each finger, from the contact on; -inf where it is not. Shape
            (n, cells, cells, 2) [m].
    """

    right: Points
    down: Points
    heights: Float64[np.ndarray, "n k k 2"]

    def held(
        self,
        pair: Int64[np.ndarray, " g"],
        rotation: Float64[np.ndarray, "g 3 3"],
        half_size: Float64[np.ndarray, "2"],
        depth: Float64[np.ndarray, " g"],
    ) -> tuple[Float64[np.ndarray, " g"], Float64[np.ndarray, "g 2"]]:
        """What pads hold that stop with their middle `depth` beyond the contacts.

        Args:
            pair: Which pair of contacts each gripper closes on. Shape (g,).
            rotation: Gripper frame in the table frame. Shape (g, 3, 3).
            half_size: Of a pad, along x and z of the gripper frame [m].
            depth: Shape (g,) [m].

        Returns:
            The area that is pressed from both sides as a share of a full pad, 0 to 1; and how far each finger stops
            before its contact, because something sticks out there [m].
        """
        steps = np.arange(-_SIDE, _SIDE + 1) * STEP_M
        across, along = steps[np.abs(steps) <= half_size[0]], steps[np.abs(steps) <= half_size[1]]
        a, b = (grid.ravel() for grid in np.meshgrid(across, along, indexing="ij"))
        cells = []
        for axis in (self.right, self.down):
            x, z = (np.einsum("gd,gd->g", rotation[:, :, k], axis[pair])[:, None] for k in (0, 2))
            cells.append(np.rint((x * a + z * (b + depth[:, None])) / STEP_M).astype(np.int64) + _SIDE)
        i, j = (np.clip(cell, 0, 2 * _SIDE) for cell in cells)
        seen = self.heights[pair[:, None], i, j]
        top = seen.max(axis=1)
        touched = (seen >= top[:, None] - SOFT_M) & np.isfinite(seen)
        area = touched.all(axis=2).sum(axis=1) * STEP_M**2
        return np.minimum(area / PAD_M2, 1.0), np.where(np.isfinite(top), top, 0.0)


def pad_maps(caster: Caster, first: Points, axis: Points, width: Numbers, right: Points) -> PadMaps:
    """The maps of pairs of contacts, from rays that run along the closing axis from just outside each of them.

    Args:
        caster: Holds the body.
        first: The first contact of each pair. Shape (n, 3) [m].
        axis: Unit vectors to the second. Shape (n, 3).
        width: Between them. Shape (n,) [m].
        right: A unit vector across each axis. Shape (n, 3).
    """
    down = np.cross(axis, right)
    steps = np.arange(-_SIDE, _SIDE + 1) * STEP_M
    grid = right[:, None, None] * steps[:, None, None] + down[:, None, None] * steps[None, :, None]
    heights = np.empty((len(first), len(steps), len(steps), 2))
    for side, way in enumerate((1.0, -1.0)):
        contact = first + (0.0 if side == 0 else 1.0) * width[:, None] * axis
        starts = contact[:, None, None] - way * _OUTSIDE_M * axis[:, None, None] + grid
        ways = np.broadcast_to(way * axis[:, None, None], starts.shape)
        distance, _ = first_hits(caster, starts.reshape(-1, 3), ways.reshape(-1, 3), 1.0)
        distance = distance.reshape(heights[..., side].shape)
        # What begins deeper than the middle of the grip is the other side's, seen past this one's edge.
        beyond = distance > _OUTSIDE_M + np.maximum(0.5 * width, SOFT_M)[:, None, None]
        heights[..., side] = np.where(beyond, -np.inf, _OUTSIDE_M - distance)
    return PadMaps(right, down, heights)
