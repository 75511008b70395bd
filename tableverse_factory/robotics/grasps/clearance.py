"""Gripper clearance: its boxes may not touch the table, anything else, or the body except between the fingers.

The open gripper is tested at the grasp and along the straight approach, as boxes stretched backwards along it.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64

from schemas.geometry import Points, TriangleMesh
from schemas.trajectories import Grasps, Numbers
from tableverse_factory.robotics.robots.arm import GripperShape
from tableverse_factory.robotics.robots.gripper_clearance import STANDOFF_M, compute_approach_openings

TABLE_CLEARANCE_M = 0.001  # minimum height of every part of the gripper above the table
SELF_CLEARANCE_M = 0.0005
OBSTACLE_CLEARANCE_M = 0.0015  # gaps to the body itself and to everything else
_STRIDES = (16, 4, 1)  # coarse subsets of points first: most obstacles are large
_CHUNK = 128
Mask = Bool[np.ndarray, "n"]
# Centers per grasp and half sizes of boxes along the axes of the gripper frame [m]
Boxes = tuple[Float64[np.ndarray, "n b 3"], Float64[np.ndarray, "b 3"]]


def find_clear_grasps(
    grasps: Grasps, gripper: GripperShape, max_opening_m: float, own: Points, others: Sequence[TriangleMesh]
) -> Mask:
    """Test which grasps in the table frame leave the gripper clear.

    `own` are surface points of the gripped body and of its convex pieces, evenly spread in their order; empty where
    that was tested before. `others` are convex pieces of everything else.
    """
    opening = compute_approach_openings(grasps.widths, max_opening_m)
    centers, half = _sweep_boxes(gripper, opening)
    kept = np.flatnonzero(_is_above_table(grasps, (centers, half)))
    for step in _STRIDES if len(own) else ():
        kept = kept[~_contains_points(grasps.select(kept), (centers[kept], half), own[::step])]
    grip_centers, grip_half = _build_grip_box(gripper, opening)
    centers, half = np.concatenate([centers, grip_centers], axis=1), np.concatenate([half, grip_half])
    for piece in others:
        kept = kept[~_collides_with_piece(grasps.select(kept), (centers[kept], half + OBSTACLE_CLEARANCE_M), piece)]
    free = np.zeros(len(grasps), dtype=bool)
    free[kept] = True
    return free


def _sweep_boxes(gripper: GripperShape, opening: Numbers) -> Boxes:
    """Stretch the gripper's boxes at these openings along the straight approach."""
    centers, half = gripper.boxes(0.0)
    fingers = len(gripper.finger_centers)
    placed = np.repeat(centers[None], len(opening), axis=0)
    placed[:, -2 * fingers : -fingers, 1] += opening[:, None] / 2
    placed[:, -fingers:, 1] -= opening[:, None] / 2
    way = np.array([0.0, 0.0, STANDOFF_M / 2])
    return placed - way, half + way


def _build_grip_box(gripper: GripperShape, opening: Numbers) -> Boxes:
    """Build one box between the fingers, at the widest opening of any grasp, which nothing else may enter."""
    low = (gripper.finger_centers - gripper.finger_half_sizes).min(axis=0)
    high = (gripper.finger_centers + gripper.finger_half_sizes).max(axis=0)
    center, half = (low + high) / 2, (high - low) / 2
    center[1], half[1] = 0.0, opening.max(initial=0.0) / 2
    return np.broadcast_to(center, (len(opening), 1, 3)), half[None]


def _is_above_table(grasps: Grasps, boxes: Boxes) -> Mask:
    """Test whether the lowest corner of every box is above the table."""
    centers, half = boxes
    down = grasps.rotations[:, 2]
    middle = grasps.positions[:, 2, None] + np.einsum("nbk,nk->nb", centers, down)
    return (middle - np.abs(down) @ half.T >= TABLE_CLEARANCE_M).all(axis=1)


def _contains_points(grasps: Grasps, boxes: Boxes, points: Points) -> Mask:
    """Test whether any point lies in any box. Uses float32: 1e-8 m at a meter is negligible here."""
    centers, half = (part.astype(np.float32) for part in boxes)
    half = half + np.float32(SELF_CLEARANCE_M)
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


def _collides_with_piece(grasps: Grasps, boxes: Boxes, piece: TriangleMesh) -> Mask:
    """Test whether a convex piece meets any box; passing edge to edge counts as touching."""
    centers, half = boxes
    low, high = piece.vertices.min(axis=0), piece.vertices.max(axis=0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    local = np.einsum("nji,nj->ni", grasps.rotations, middle - grasps.positions)
    outside = np.maximum(np.abs(local[:, None] - centers) - half, 0.0)
    near = (np.einsum("nbk,nbk->nb", outside, outside) <= radius**2).any(axis=1)
    touching = np.zeros(len(grasps), dtype=bool)
    index = np.flatnonzero(near)
    touching[index] = _overlaps_boxes(grasps.select(index.astype(np.int32)), (centers[index], half), piece)
    return touching


def _overlaps_boxes(grasps: Grasps, boxes: Boxes, piece: TriangleMesh) -> Mask:
    """Run the separating axis test of every grasp's boxes and a piece, without edge-edge axes."""
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
    return (~apart).any(axis=1)
