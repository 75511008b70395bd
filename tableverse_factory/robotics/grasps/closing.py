"""What two pads find between them when they close: where they stop, how much they hold, and on what slope."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Points, TriangleMesh
from schemas.trajectories import Grasps, Numbers
from tableverse_factory.geometry.mesh.height_maps import Caster, column_caster
from tableverse_factory.geometry.relations.antipodal import first_hits
from tableverse_factory.robotics.robots.arm import GripperShape

SOFT_M = 0.001
"""Pads press on what lies this far behind the first point that they touch: a body turns a little as it is gripped."""

_RAYS, _OUTERMOST = 4, 0.9
"""Along either side of a pad, and how far out the last one is: what lies flat is held by the very tips."""

Rotations = Float64[np.ndarray, "n 3 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Hold(Frozen):
    """What pads hold, per grasp.

    Attributes:
        width: Between the pads when both touch; not positive, or NaN, where they meet nothing. Shape (n,) [m].
        sideways: From the middle of the gripper to the middle between the pads, along the closing axis. Shape (n,) [m].
        share: Of the pads' area, what presses on something from both sides. Shape (n,).
        slope: Cosine between the closing axis and the mean normal of what a pad presses on, the smaller of the two.
            Where it is as low as that of the friction cone, the body is squeezed out. Shape (n,).
    """

    width: Numbers
    sideways: Numbers
    share: Numbers
    slope: Numbers


def hold(rotations: Rotations, positions: Points, openings: Numbers, caster: Caster, gripper: GripperShape) -> Hold:
    """Closes pads, each seen as `_RAYS` x `_RAYS` rays.

    Args:
        rotations: Gripper frame in the table frame. Shape (n, 3, 3).
        positions: TCP in the table frame. Shape (n, 3) [m].
        openings: Between the pads before they close. Shape (n,) [m].
        caster: Holds what the pads feel.
        gripper: Its pads.
    """
    cells = np.linspace(-_OUTERMOST, _OUTERMOST, _RAYS)
    x, z = np.meshgrid(gripper.pad_half_size_xz[0] * cells, gripper.pad_half_size_xz[1] * cells, indexing="ij")
    across, along = rotations[:, None, :, 0], rotations[:, None, :, 2]
    grid = positions[:, None] + x.reshape(1, -1, 1) * across + z.reshape(1, -1, 1) * along
    axis, half = rotations[:, :, 1], 0.5 * openings
    stops, touched, slopes = [], [], []
    for side in (-1.0, 1.0):
        starts = grid + side * half[:, None, None] * axis[:, None]
        ways = np.broadcast_to(-side * axis[:, None], grid.shape)
        distance, normals = first_hits(caster, starts.reshape(-1, 3), ways.reshape(-1, 3), 1.0)
        distance = distance.reshape(grid.shape[:2])
        nearest = distance.min(axis=1)
        near = distance <= nearest[:, None] + SOFT_M
        mean = np.einsum("nc,nci->ni", near.astype(np.float64), _against(normals.reshape(grid.shape), ways))
        length = np.maximum(np.linalg.norm(mean, axis=1), 1e-12)
        stops.append(half - nearest)
        touched.append(near & np.isfinite(distance))
        slopes.append(side * np.einsum("ni,ni->n", mean, axis) / length)
    with np.errstate(invalid="ignore"):  # where both meet nothing
        width, sideways = stops[0] + stops[1], 0.5 * (stops[1] - stops[0])
    return Hold(width, sideways, (touched[0] & touched[1]).mean(axis=1), np.minimum(*slopes))


def _against(normals: Points, ways: Points) -> Points:
    """Normals on the side from which the rays come, whichever way the faces were wound."""
    facing = np.einsum("nci,nci->nc", normals, ways)[..., None]
    turned: Points = np.where(facing > 0.0, -normals, normals)
    return turned


def closed(grasps: Grasps, felt: TriangleMesh, gripper: GripperShape, max_opening_m: float) -> Grasps:
    """The grasps with the width at which wide open pads stop at a body, moved so that they touch it together.

    Grasps that close on nothing are left out.

    Args:
        grasps: Table frame; their widths are not read.
        felt: What the pads feel of the body as it stands, table frame [m].
        gripper: Its pads.
        max_opening_m: Where they start [m].
    """
    wide = np.full(len(grasps), max_opening_m)
    found = hold(grasps.rotations, grasps.positions, wide, column_caster(felt), gripper)
    kept = np.flatnonzero(found.width > 0.0).astype(np.int32)
    some = grasps.chosen(kept)
    moved = some.positions + found.sideways[kept, None] * some.rotations[:, :, 1]
    return Grasps(some.rotations, moved, found.width[kept], some.scores)
