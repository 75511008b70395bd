"""Phase 2: outward from the most central group, each group along its own azimuth until it is clear (equation (2))."""

from collections.abc import Sequence
from itertools import chain

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Vector3
from tableverse_factory.geometry.collision.linear_sweep import LinearSweep
from tableverse_factory.stages.rectify.groups import Group
from tableverse_factory.stages.rectify.rigid_part import RigidPart, compute_center

COINCIDENT_M = 1e-9  # nearer centres have no direction between them; distances that differ by less are a tie [m]


def order_radially(parts: Sequence[RigidPart], groups: Sequence[Group]) -> list[Group]:
    """Order groups by the distance of their centres from the root's, ties by object id.

    The root, which comes first, is the group whose centre lies nearest to the mean of all centres.
    """
    centers = np.array([compute_center(list_members(parts, group)) for group in groups])
    to_mean = np.rint(np.linalg.norm(centers - centers.mean(axis=0), axis=1) / COINCIDENT_M)
    names = [min(part.object_id for part in list_members(parts, group)) for group in groups]
    root = min(range(len(groups)), key=lambda k: (to_mean[k], names[k]))
    to_root = np.rint(np.linalg.norm(centers - centers[root], axis=1) / COINCIDENT_M)
    order = sorted(range(len(groups)), key=lambda k: (k != root, to_root[k], names[k]))
    return [groups[k] for k in order]


def spread_groups(parts: Sequence[RigidPart], ordered: Sequence[Group], clearance_m: float) -> list[RigidPart]:
    """Move each group but the first outward by the least distance that clears it of all groups before it."""
    moved = list(parts)
    anchors = list_members(moved, ordered[0])
    origin = compute_center(anchors)
    for group in ordered[1:]:
        mine = list_members(moved, group)
        direction = compute_outward(mine, origin)
        bodies, fixed = [part.body for part in mine], [part.body for part in anchors]
        distance = LinearSweep(direction).find_first_clear(bodies, fixed, clearance_m)
        for i in chain(*group):
            moved[i] = moved[i].moved(distance * direction)
            anchors.append(moved[i])
    return moved


def compute_outward(group: Sequence[RigidPart], origin: np.ndarray) -> Vector3:
    """Compute the unit vector from the root's centre to the group's (equation (1)), in the plane.

    Where the centres coincide it is the heading of the group's first object, which turns with the layout.
    """
    away = compute_center(group) - origin
    length = float(np.linalg.norm(away))
    if length < COINCIDENT_M:
        away, length = min(group, key=lambda part: part.object_id).heading, 1.0
    return np.array([away[0] / length, away[1] / length, 0.0])


def compute_azimuths(parts: Sequence[RigidPart], ordered: Sequence[Group]) -> Float64[np.ndarray, " n"]:
    """Compute the direction of each group's centre from that of the first [rad]; NaN where they coincide."""
    away = np.array([compute_center(list_members(parts, group)) for group in ordered])
    away -= away[0]
    angles = np.arctan2(away[:, 1], away[:, 0])
    return np.where(np.linalg.norm(away, axis=1) < COINCIDENT_M, np.nan, angles)


def list_members(parts: Sequence[RigidPart], group: Group) -> list[RigidPart]:
    """List the parts of a group."""
    return [parts[i] for i in chain(*group)]
