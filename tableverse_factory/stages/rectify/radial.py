"""Phase 2: outward from the most central group, each group along its own azimuth until it is clear (equation (2))."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Vector3
from tableverse_factory.geometry.collision.ray_clearance import Ray
from tableverse_factory.stages.rectify.groups import Group
from tableverse_factory.stages.rectify.rigid_part import RigidPart, center_of

COINCIDENT_M = 1e-9
"""Centres nearer than this have no direction between them, and distances that differ by less are a tie."""


def radial_order(parts: Sequence[RigidPart], groups: Sequence[Group]) -> list[Group]:
    """The root, then the other groups by the distance of their centres from it; ties go by object id.

    The root is the group whose centre lies nearest to the mean of all centres.
    """
    centers = np.array([center_of(members(parts, group)) for group in groups])
    to_mean = np.linalg.norm(centers - centers.mean(axis=0), axis=1)
    names = [min(part.object_id for part in members(parts, group)) for group in groups]
    root = min(range(len(groups)), key=lambda k: (_rounded(to_mean[k]), names[k]))
    to_root = np.linalg.norm(centers - centers[root], axis=1)
    order = sorted(range(len(groups)), key=lambda k: (k != root, _rounded(to_root[k]), names[k]))
    return [groups[k] for k in order]


def spread(parts: Sequence[RigidPart], ordered: Sequence[Group], clearance_m: float) -> list[RigidPart]:
    """Moves each group but the first outward by the least distance that clears it of all groups before it."""
    moved = list(parts)
    anchors = list(members(moved, ordered[0]))
    origin = center_of(anchors)
    for group in ordered[1:]:
        mine = members(moved, group)
        direction = outward(mine, origin)
        distance = Ray(direction).first_clear(
            [part.body for part in mine], [part.body for part in anchors], clearance_m
        )
        for entity in group:
            for i in entity:
                moved[i] = moved[i].moved(distance * direction)
                anchors.append(moved[i])
    return moved


def outward(group: Sequence[RigidPart], origin: np.ndarray) -> Vector3:
    """Unit vector from the root's centre to the group's (equation (1)), in the plane.

    Where the two centres coincide it is the heading of the group's first object: any direction would do, and this
    one turns with the layout.
    """
    away = center_of(group) - origin
    length = float(np.linalg.norm(away))
    if length < COINCIDENT_M:
        away, length = min(group, key=lambda part: part.object_id).heading, 1.0
    return np.array([away[0] / length, away[1] / length, 0.0])


def azimuths(parts: Sequence[RigidPart], ordered: Sequence[Group]) -> Float64[np.ndarray, " n"]:
    """Direction of each group's centre from that of the first [rad]; NaN where they coincide."""
    away = np.array([center_of(members(parts, group)) for group in ordered])
    away -= away[0]
    angles = np.arctan2(away[:, 1], away[:, 0])
    return np.where(np.linalg.norm(away, axis=1) < COINCIDENT_M, np.nan, angles)


def members(parts: Sequence[RigidPart], group: Group) -> list[RigidPart]:
    """The parts of a group."""
    return [parts[i] for entity in group for i in entity]


def _rounded(distance: float) -> int:
    return round(float(distance) / COINCIDENT_M)
