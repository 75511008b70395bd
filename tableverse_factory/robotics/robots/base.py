"""Base placement: on free table or beside it, so that the gripper reaches all targets."""

import mujoco
import numpy as np
from jaxtyping import Float64

from schemas.geometry import Points, Pose
from tableverse_factory.core.errors import InputError
from tableverse_factory.geometry.math.transforms import quaternion_about_z, rotation_matrix
from tableverse_factory.robotics.robots.gripper_clearance import LIFT_M
from tableverse_factory.robotics.robots.reach import ReachMap, compute_reach_map
from tableverse_factory.robotics.robots.station import Station

ELBOW_MARGIN_M = 0.06  # clearance between the base's foot and any object, for the shoulder and the elbow to swing
EDGE_GAP_M = 0.02  # gap between the table's edge and the pedestal of a base beside it
MAX_MARGIN_M = 0.1  # reach margin beyond which a place is no better
BASE_SPACING_M = 0.2  # minimum distance between two returned bases
_DISTANCES_M = np.arange(0.3, 1.2001, 0.05)
_ANGLES = np.arange(36) * (2 * np.pi / 36)  # counter-clockwise from the viewer's side, -y
Points2 = Float64[np.ndarray, "n 2"]


def find_bases(station: Station, targets: Points, most: int = 8) -> list[Pose]:
    """Find up to `most` base poses from which the TCP reaches all targets of the table frame [m], best first.

    Poses are ranked by the smallest margin to the border of the reach, capped at `MAX_MARGIN_M`; then by angle from the
    viewer's side, -y; then by distance to the targets, whose middle the base faces. The station's base stays unchanged.
    """
    if len(targets) == 0:
        raise ValueError("no targets: give at least one point")
    low, high = targets[:, :2].min(axis=0), targets[:, :2].max(axis=0)
    middle = (low + high) / 2
    radii, angles = (grid.ravel() for grid in np.meshgrid(_DISTANCES_M, _ANGLES))
    feet = middle + radii[:, None] * np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    margins = _compute_least_margins(compute_reach_map(station.arm), feet, targets)
    near = np.flatnonzero(margins > 0.0)
    fits = near[_has_footing(station, feet[near])]
    side = np.minimum(angles, 2 * np.pi - angles)
    worth = np.round(np.minimum(margins, MAX_MARGIN_M), 3)
    order = fits[np.lexsort((angles[fits], radii[fits].round(6), side[fits].round(6), -worth[fits]))]
    return _select_bases(station, feet[order], middle, most)


def _select_bases(station: Station, feet: Points2, middle: np.ndarray, most: int) -> list[Pose]:
    """Select feet that are spaced apart and where the arm at home collides with nothing."""
    kept: list[Pose] = []
    before, data = station.base, station.data()
    for foot in feet:
        if len(kept) == most:
            break
        if any(np.linalg.norm(foot - pose.position[:2]) < BASE_SPACING_M for pose in kept):
            continue
        toward = middle - foot
        pose = Pose(np.array([*foot, 0.0]), quaternion_about_z(float(np.arctan2(toward[1], toward[0]))))
        station.place_base(pose)
        mujoco.mj_fwdPosition(station.model, data)
        if not np.isin(station.model.geom_bodyid[data.contact.geom], station.arm_bodies).any():
            kept.append(pose)
    station.place_base(before)
    return kept


def _compute_least_margins(reach: ReachMap, feet: Points2, targets: Points) -> np.ndarray:
    """Compute the least margin of any target and of its lift's end, from each foot. Shape (n,) [m]."""
    distances = np.linalg.norm(feet[:, None] - targets[None, :, :2], axis=2)
    heights = np.broadcast_to(np.maximum(targets[:, 2], 0.0), distances.shape)
    low, high = reach.margin(distances, heights), reach.margin(distances, heights + LIFT_M)
    return np.minimum(low, high).min(axis=1)


def _has_footing(station: Station, feet: Points2) -> np.ndarray:
    """Test which feet stand wholly on or wholly beside the table, clear of all objects. Shape (n,)."""
    radius = station.arm.base_radius_m
    inside = _compute_table_margin(station, feet)
    stands = (inside >= radius) | (inside <= -(station.pedestal_radius_m + EDGE_GAP_M))
    for outline in station.outlines:
        stands &= _compute_outline_distance(outline, feet) >= radius + ELBOW_MARGIN_M
    return stands


def _compute_table_margin(station: Station, feet: Points2) -> np.ndarray:
    """Compute how far inside the table's edges each foot is, negative outside. Shape (n,) [m]."""
    model = station.model
    tops = [
        geom
        for geom in range(model.ngeom)
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX
        and model.body(int(model.geom_bodyid[geom])).name == "table"
    ]
    if not tops:
        raise InputError("the scene has no box in a body 'table' for a base to stand on or beside", "bad_mjcf")
    body = int(model.geom_bodyid[tops[0]])
    along = (feet - model.body_pos[body][:2]) @ rotation_matrix(model.body_quat[body])[:2, :2]
    beyond = np.abs(along) - model.geom_size[tops[0]][:2]
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return np.where(outside > 0.0, -outside, -beyond.max(axis=1))


def _compute_outline_distance(outline: Points2, feet: Points2) -> np.ndarray:
    """Compute the distance from each foot to a convex outline, 0 inside. Shape (n,) [m]."""
    start, edge = outline, np.roll(outline, -1, axis=0) - outline
    offset = feet[:, None] - start[None]
    share = np.clip((offset * edge).sum(2) / np.maximum((edge * edge).sum(1), 1e-18), 0.0, 1.0)
    distance = np.linalg.norm(offset - share[..., None] * edge, axis=2).min(axis=1)
    cross = edge[None, :, 0] * offset[..., 1] - edge[None, :, 1] * offset[..., 0]
    return np.where((cross >= 0.0).all(axis=1), 0.0, distance)
