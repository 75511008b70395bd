"""Room for the gripper: no box of it may touch the table, the body besides between the fingers, or anything else.

The open gripper is tested where it takes hold and along the straight way to there, as boxes that are longer towards
where it comes from.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64

from schemas.geometry import Points, TriangleMesh
from schemas.trajectories import Grasps, Numbers
from tableverse_factory.robotics.robots.arm import GripperShape
from tableverse_factory.robotics.robots.gripper_clearance import STANDOFF_M, openings

TABLE_M = 0.001
"""Least height of every part of the gripper above the table."""

OWN_M = 0.0005
OTHERS_M = 0.0015
"""Gaps to the body itself and to everything else."""

_STEPS = (16, 4, 1)
"""Few points first: what is in the way is mostly large."""
_CHUNK = 128

Mask = Bool[np.ndarray, "n"]
Boxes = tuple[Float64[np.ndarray, "n b 3"], Float64[np.ndarray, "b 3"]]
"""Centres per grasp and half sizes of boxes along the axes of the gripper frame [m]."""


def clear(
    grasps: Grasps, gripper: GripperShape, max_opening_m: float, own: Points, others: Sequence[TriangleMesh]
) -> Mask:
    """Which grasps have room.

    Args:
        grasps: Table frame.
        gripper: Its shape.
        max_opening_m: Its widest opening [m].
        own: Points of the surface of the body that is gripped, table frame, evenly spread in their order; those of
            its convex pieces too, where a simulation feels them; none where that was asked before. Shape (p, 3) [m].
        others: Convex pieces of everything else, table frame [m].
    """
    opening = openings(grasps.widths, max_opening_m)
    centers, half = _swept(gripper, opening)
    kept = np.flatnonzero(_above_table(grasps, (centers, half)))
    for step in _STEPS if len(own) else ():
        kept = kept[~_holds_points(grasps.chosen(kept), (centers[kept], half), own[::step])]
    grip_centers, grip_half = _between(gripper, opening)
    centers, half = np.concatenate([centers, grip_centers], axis=1), np.concatenate([half, grip_half])
    for piece in others:
        kept = kept[~_touches_piece(grasps.chosen(kept), (centers[kept], half + OTHERS_M), piece)]
    free = np.zeros(len(grasps), dtype=bool)
    free[kept] = True
    return free


def _swept(gripper: GripperShape, opening: Numbers) -> Boxes:
    """The gripper's boxes at these openings and on their straight way to there."""
    centers, half = gripper.boxes(0.0)
    fingers = len(gripper.finger_centers)
    placed = np.repeat(centers[None], len(opening), axis=0)
    placed[:, -2 * fingers : -fingers, 1] += opening[:, None] / 2
    placed[:, -fingers:, 1] -= opening[:, None] / 2
    way = np.array([0.0, 0.0, STANDOFF_M / 2])
    return placed - way, half + way


def _between(gripper: GripperShape, opening: Numbers) -> Boxes:
    """One box between the fingers, as wide as the widest opening of any: where nothing else may be when they close."""
    low = (gripper.finger_centers - gripper.finger_half_sizes).min(axis=0)
    high = (gripper.finger_centers + gripper.finger_half_sizes).max(axis=0)
    center, half = (low + high) / 2, (high - low) / 2
    center[1], half[1] = 0.0, opening.max(initial=0.0) / 2
    return np.broadcast_to(center, (len(opening), 1, 3)), half[None]


def _above_table(grasps: Grasps, boxes: Boxes) -> Mask:
    """Whether the lowest corner of every box is above the table, and the gripper does not come from below."""
    centers, half = boxes
    down = grasps.rotations[:, 2]
    middle = grasps.positions[:, 2, None] + np.einsum("nbk,nk->nb", centers, down)
    free: Mask = (middle - np.abs(down) @ half.T >= TABLE_M).all(axis=1)
    return free


def _holds_points(grasps: Grasps, boxes: Boxes, points: Points) -> Mask:
    """Whether any of the points lies in any of the boxes. In float32: 1e-8 m at a metre decides nothing here."""
    centers, half = (part.astype(np.float32) for part in boxes)
    half = half + np.float32(OWN_M)
    rows = np.ascontiguousarray(points.T.astype(np.float32))
    turned = grasps.rotations.transpose(0, 2, 1).astype(np.float32)
    origin = np.einsum("nij,nj->ni", turned, grasps.positions.astype(np.float32))
    inside = np.zeros(len(grasps), dtype=bool)
    for start in range(0, len(grasps), _CHUNK):
        part = slice(start, start + _CHUNK)
        local = (turned[part].reshape(-1, 3) @ rows).reshape(-1, 3, rows.shape[1]) - origin[part, :, None]
        for box in range(len(half)):
            near = np.abs(local - centers[part, box, :, None]) <= half[box, :, None]
            inside[part] |= (near[:, 0] & near[:, 1] & near[:, 2]).any(axis=1)
    return inside


def _touches_piece(grasps: Grasps, boxes: Boxes, piece: TriangleMesh) -> Mask:
    """Whether a convex piece meets any box, by the axes of both; what passes only edge to edge counts as touching."""
    centers, half = boxes
    low, high = piece.vertices.min(axis=0), piece.vertices.max(axis=0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    local = np.einsum("nji,nj->ni", grasps.rotations, middle - grasps.positions)
    outside = np.maximum(np.abs(local[:, None] - centers) - half, 0.0)
    near = (np.einsum("nbk,nbk->nb", outside, outside) <= radius**2).any(axis=1)
    touching = np.zeros(len(grasps), dtype=bool)
    index = np.flatnonzero(near)
    touching[index] = _overlaps(grasps.chosen(index.astype(np.int32)), (centers[index], half), piece)
    return touching


def _overlaps(grasps: Grasps, boxes: Boxes, piece: TriangleMesh) -> Mask:
    """The separating axis test of every grasp's boxes and a piece, without the axes across two edges."""
    centers, half = boxes
    corners = piece.vertices[piece.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 0.0] / lengths[lengths > 0.0, None]
    reach = (normals @ piece.vertices.T).max(axis=1)
    turned = np.einsum("fi,nij->nfj", normals, grasps.rotations)
    middle = np.einsum("nbj,nfj->nbf", centers, turned) + (grasps.positions @ normals.T)[:, None]
    apart = (middle - np.einsum("bj,nfj->nbf", half, np.abs(turned)) > reach).any(axis=2)
    local = np.einsum("nji,nvj->nvi", grasps.rotations, piece.vertices[None] - grasps.positions[:, None])
    low, high = local.min(axis=1)[:, None], local.max(axis=1)[:, None]
    apart |= ((low > centers + half) | (high < centers - half)).any(axis=2)
    overlapping: Mask = (~apart).any(axis=1)
    return overlapping
