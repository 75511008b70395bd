"""Closing pads on a mesh: where they stop, how much they hold, and on what slope."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Points, TriangleMesh
from schemas.trajectories import Grasps, Numbers
from tableverse_factory.geometry.mesh.raycasting import RaycastingScene, make_raycasting_scene
from tableverse_factory.geometry.relations.antipodal import cast_surface_rays
from tableverse_factory.robotics.robots.arm import GripperShape

# Pads press on everything this far behind the first contact: a body turns slightly as it is gripped
PAD_COMPLIANCE_M = 0.001
# Rays along either side of a pad, and position of the outermost: flat objects are held by the very tips
_RAYS, _OUTER_SHARE = 4, 0.9
Rotations = Float64[np.ndarray, "n 3 3"]


@dataclass(frozen=True, slots=True, eq=False)
class PadContact(Frozen):
    """Contact of closed pads, per grasp.

    `slope` is the cosine between the closing axis and the mean contact normal, the smaller of both pads; at or below
    that of the friction cone, the body is squeezed out.
    """

    width: Numbers  # between the pads when both touch; not positive, or NaN, where they meet nothing [m]
    sideways: Numbers  # from the gripper's middle to that between the pads, along the closing axis [m]
    share: Numbers  # of the pads' area that presses from both sides
    slope: Numbers


def close_pads(
    rotations: Rotations, positions: Points, openings: Numbers, caster: RaycastingScene, gripper: GripperShape
) -> PadContact:
    """Close pads, each represented by `_RAYS` x `_RAYS` rays, on the surface in `caster`.

    Grasps are given by the gripper frame in the table frame; `openings` are the distances before closing [m].
    """
    cells = np.linspace(-_OUTER_SHARE, _OUTER_SHARE, _RAYS)
    x, z = np.meshgrid(gripper.pad_half_size_xz[0] * cells, gripper.pad_half_size_xz[1] * cells, indexing="ij")
    across, along = rotations[:, None, :, 0], rotations[:, None, :, 2]
    grid = positions[:, None] + x.reshape(1, -1, 1) * across + z.reshape(1, -1, 1) * along
    axis, half = rotations[:, :, 1], 0.5 * openings
    stops, touched, slopes = [], [], []
    for side in (-1.0, 1.0):
        starts = grid + side * half[:, None, None] * axis[:, None]
        ways = np.broadcast_to(-side * axis[:, None], grid.shape)
        distance, normals = cast_surface_rays(caster, starts.reshape(-1, 3), ways.reshape(-1, 3), 1.0)
        distance = distance.reshape(grid.shape[:2])
        nearest = distance.min(axis=1)
        near = distance <= nearest[:, None] + PAD_COMPLIANCE_M
        normals = normals.reshape(grid.shape)
        facing = np.einsum("nci,nci->nc", normals, ways)[..., None]
        normals = np.where(facing > 0.0, -normals, normals)  # against the rays, whatever the winding of the faces
        mean = np.einsum("nc,nci->ni", near.astype(np.float64), normals)
        length = np.maximum(np.linalg.norm(mean, axis=1), 1e-12)
        stops.append(half - nearest)
        touched.append(near & np.isfinite(distance))
        slopes.append(side * np.einsum("ni,ni->n", mean, axis) / length)
    with np.errstate(invalid="ignore"):  # where both meet nothing
        width, sideways = stops[0] + stops[1], 0.5 * (stops[1] - stops[0])
    return PadContact(width, sideways, (touched[0] & touched[1]).mean(axis=1), np.minimum(*slopes))


def close_grasps(grasps: Grasps, felt: TriangleMesh, gripper: GripperShape, max_opening_m: float) -> Grasps:
    """Set the width at which fully open pads stop at a body, and center each grasp; drop grasps that meet nothing.

    `felt` are the body's convex pieces in the table frame [m]; widths of `grasps` are not read.
    """
    wide = np.full(len(grasps), max_opening_m)
    found = close_pads(grasps.rotations, grasps.positions, wide, make_raycasting_scene(felt), gripper)
    kept = np.flatnonzero(found.width > 0.0).astype(np.int32)
    some = grasps.select(kept)
    moved = some.positions + found.sideways[kept, None] * some.rotations[:, :, 1]
    return Grasps(some.rotations, moved, found.width[kept], some.scores)
