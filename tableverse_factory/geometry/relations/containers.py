"""Whether a container holds an object: one answer for assembly, settling and the certificate."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from schemas.geometry import Frozen, TriangleMesh
from tableverse_factory.geometry.mesh.height_maps import CellMask
from tableverse_factory.geometry.relations.relations import BodyFeatures, compute_body_features, is_inside

FOOT_TOLERANCE_M = 0.003  # an object that reaches further below the container's foot stands beside it
INSIDE_SHARE = 0.5  # share of an object below the rim that is within the opening: objects lean out of full bowls
DIP_M = 0.003
HEAP_SHARE = 2 / 3  # share of an object on a heap that is over the opening: a pen across a cup is not in it


@dataclass(frozen=True, slots=True, eq=False)
class HollowVessel(Frozen):
    """A container as it stands; a dish, or a vessel on its side, has no cavity.

    Contents can be in the room, cells of the cavity or else all of the body's map, above its floor or foot [m].
    """

    body: BodyFeatures
    room: CellMask
    floor_z: float

    def holds(self, mesh: TriangleMesh) -> bool:
        """Whether an object at rest, in the same frame, lies in the container or on the heap in it.

        It reaches into the cavity, and most of what is below the rim is within the opening (the relation `in` asks for
        nearly all). Or its middle is over the room, and it dips in or lies on a heap: most of it is over the opening.
        """
        thing = compute_body_features(mesh)
        if float(thing.low[2]) < float(self.body.low[2]) - FOOT_TOLERANCE_M:
            return False
        if is_inside(thing, self.body, INSIDE_SHARE):
            return True
        over = thing.heights.window(self.body.heights, self.room, False)
        middle = tuple(int(thing.center[k] // self.body.heights.cell) - thing.heights.corner[k] for k in range(2))
        if not over[middle] or float(thing.center[2]) < self.floor_z:
            return False
        cavity = self.body.cavity
        dips = cavity is None or float(thing.low[2]) < cavity.rim_z - DIP_M
        return dips or float(over[thing.heights.filled].mean()) >= HEAP_SHARE


def make_hollow_vessel(mesh: TriangleMesh) -> HollowVessel:
    """Make the container of a mesh that stands in a frame with z up."""
    body = compute_body_features(mesh)
    if body.cavity is not None:
        return HollowVessel(body, body.cavity.cells, body.cavity.floor_z)
    covered = ndimage.binary_fill_holes(body.heights.filled)
    return HollowVessel(body, np.asarray(covered), float(body.low[2]))
