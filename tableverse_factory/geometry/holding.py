"""Whether a container holds a thing: one answer for assembly, settling and the certificate."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from schemas.geometry import Frozen, TriangleMesh
from tableverse_factory.geometry.height_maps import CellMask
from tableverse_factory.geometry.relations import Body, body_of, is_inside

FOOT_TOLERANCE_M = 0.003
"""A thing that reaches further below the container's foot stands beside it."""


@dataclass(frozen=True, slots=True, eq=False)
class Holder(Frozen):
    """A container as it stands.

    Attributes:
        body: Its mesh, measured; a dish or a vessel on its side has no cavity.
        room: Cells of the body's map over which things in it have their middle.
        floor_z: Where its room begins: the floor of the cavity, or the foot of what has none [m].
        rim_z: Where it ends: the rim, or the top of what has none [m].
    """

    body: Body
    room: CellMask
    floor_z: float
    rim_z: float

    def holds(self, mesh: TriangleMesh) -> bool:
        """Whether a thing that lies still, in the same frame, lies in the container or on the heap in it.

        It reaches into the cavity and is within its opening as far as it is below the rim, as the relation `in` asks;
        or its middle is over the opening. Where there is no cavity its middle is over the container.
        """
        thing = body_of(mesh)
        if float(thing.low[2]) < float(self.body.low[2]) - FOOT_TOLERANCE_M:
            return False
        return is_inside(thing, self.body) or self._is_over(thing)

    def _is_over(self, thing: Body) -> bool:
        if float(thing.center[2]) < self.floor_z:
            return False
        heights = self.body.heights
        i, j = (int(np.floor(thing.center[k] / heights.cell)) - heights.corner[k] for k in range(2))
        nx, ny = self.room.shape
        return 0 <= i < nx and 0 <= j < ny and bool(self.room[i, j])


def holder_of(mesh: TriangleMesh) -> Holder:
    """The container of a mesh that stands in a frame with z up."""
    body = body_of(mesh)
    if body.cavity is not None:
        return Holder(body, body.cavity.cells, body.cavity.floor_z, body.cavity.rim_z)
    covered = ndimage.binary_fill_holes(body.heights.filled)
    return Holder(body, np.asarray(covered), float(body.low[2]), float(body.high[2]))
