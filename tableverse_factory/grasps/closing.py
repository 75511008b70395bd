"""Where fingers stop that close on a body: for grasps whose width nobody said."""

import numpy as np

from schemas.geometry import TriangleMesh
from schemas.trajectories import Grasps
from tableverse_factory.geometry.grasping import first_hits
from tableverse_factory.geometry.height_maps import caster_of
from tableverse_factory.robots.arm import GripperShape

_PER_SIDE = 5


def closed(grasps: Grasps, mesh: TriangleMesh, gripper: GripperShape, max_opening_m: float) -> Grasps:
    """The grasps with the width at which both pads touch the body, moved so that they touch it together.

    Grasps that close on nothing are left out. Pads are seen as `_PER_SIDE` x `_PER_SIDE`
    rays each.

    Args:
        grasps: Table frame; their widths are not read.
        mesh: The body as it stands, table frame [m].
        gripper: Its pads.
        max_opening_m: Where they start [m].
    """
    if not len(grasps):
        return grasps
    caster = caster_of(mesh)
    x, z = (np.linspace(-half, half, _PER_SIDE) for half in gripper.pad_half_size_xz)
    grid = np.stack([part.ravel() for part in np.meshgrid(x, [0.0], z, indexing="ij")], axis=1)
    stops = []
    for side in (-1.0, 1.0):
        starts = grid + np.array([0.0, side * max_opening_m / 2, 0.0])
        origins = np.einsum("nij,gj->ngi", grasps.rotations, starts) + grasps.positions[:, None]
        ways = np.broadcast_to(-side * grasps.rotations[:, None, :, 1], origins.shape)
        distance, _ = first_hits(caster, origins.reshape(-1, 3), ways.reshape(-1, 3), 1.0)
        stops.append(max_opening_m / 2 - distance.reshape(len(grasps), -1).min(axis=1))
    left, right = stops  # from the middle of the gripper to the body, towards each finger
    kept = np.flatnonzero(np.isfinite(left) & np.isfinite(right)).astype(np.int32)
    width, sideways = left[kept] + right[kept], 0.5 * (right[kept] - left[kept])
    some = grasps.chosen(kept)
    moved = some.positions + sideways[:, None] * some.rotations[:, :, 1]
    return Grasps(some.rotations, moved, width, some.scores)
