"""Where the arm's base may stand: on free table or beside it, so that the gripper reaches all it is asked to."""

import mujoco
import numpy as np
from jaxtyping import Float64

from schemas.geometry import Points, Pose
from tableverse_factory.core.errors import InputError
from tableverse_factory.geometry.math.transforms import quaternion_about_z, rotation_matrix
from tableverse_factory.robotics.robots.gripper_clearance import RISE_M
from tableverse_factory.robotics.robots.reach import Reach, reach_of
from tableverse_factory.robotics.robots.station import Station

ELBOW_MARGIN_M = 0.06
"""Room between the base's foot and any object, for the shoulder and the elbow to swing."""

EDGE_GAP_M = 0.02
"""Between the edge of the table and the pedestal of a base beside it."""

WELL_INSIDE_M = 0.1
"""More margin than this to the border of the reach is worth nothing."""

APART_M = 0.2
"""Two bases that are offered differ by at least this much."""

_DISTANCES_M = np.arange(0.3, 1.2001, 0.05)
_ANGLES = np.arange(36) * (2 * np.pi / 36)
"""From the viewer's side, -y, counter-clockwise."""

Points2 = Float64[np.ndarray, "n 2"]


def bases(station: Station, targets: Points, most: int = 8) -> list[Pose]:
    """Places for the base from which all targets are reached, best first; none where nothing fits.

    Best is where the least of all margins to the border of the reach is largest, up to `WELL_INSIDE_M`; then nearest
    to the viewer's side, -y; then nearest to the targets. The base faces the middle of the targets. The station's own
    base is where it was afterwards.

    Args:
        station: The scene, in its exported state, with its arm.
        targets: Where the TCP has to work, in the table frame. Shape (n, 3) [m].
        most: How many places are returned.

    Raises:
        InputError: `bad_mjcf` if the scene has no table.
        ValueError: if there are no targets.
    """
    if len(targets) == 0:
        raise ValueError("no targets: give at least one point")
    low, high = targets[:, :2].min(axis=0), targets[:, :2].max(axis=0)
    middle = (low + high) / 2
    radii, angles = (grid.ravel() for grid in np.meshgrid(_DISTANCES_M, _ANGLES))
    feet = middle + radii[:, None] * np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    margins = _least_margins(reach_of(station.arm), feet, targets)
    near = np.flatnonzero(margins > 0.0)
    fits = near[_stands(station, feet[near])]
    side = np.minimum(angles, 2 * np.pi - angles)
    worth = np.round(np.minimum(margins, WELL_INSIDE_M), 3)
    order = fits[np.lexsort((angles[fits], radii[fits].round(6), side[fits].round(6), -worth[fits]))]
    return _chosen(station, feet[order], middle, most)


def _chosen(station: Station, feet: Points2, middle: np.ndarray, most: int) -> list[Pose]:
    """The first feet that are apart from one another and where the arm at home touches nothing."""
    kept: list[Pose] = []
    before, data = station.base, station.data()
    for foot in feet:
        if len(kept) == most:
            break
        if any(np.linalg.norm(foot - pose.position[:2]) < APART_M for pose in kept):
            continue
        toward = middle - foot
        pose = Pose(np.array([*foot, 0.0]), quaternion_about_z(float(np.arctan2(toward[1], toward[0]))))
        station.place_base(pose)
        if not _arm_touches(station, data):
            kept.append(pose)
    station.place_base(before)
    return kept


def _least_margins(reach: Reach, feet: Points2, targets: Points) -> np.ndarray:
    """The least margin of any target, and of where a lift from it ends, from each foot. Shape (n,) [m]."""
    distances = np.linalg.norm(feet[:, None] - targets[None, :, :2], axis=2)
    heights = np.broadcast_to(np.maximum(targets[:, 2], 0.0), distances.shape)
    low, high = reach.margin(distances, heights), reach.margin(distances, heights + RISE_M)
    least: np.ndarray = np.minimum(low, high).min(axis=1)
    return least


def _stands(station: Station, feet: Points2) -> np.ndarray:
    """Which feet stand wholly on the table or wholly beside it, clear of all objects. Shape (n,)."""
    radius = station.arm.base_radius_m
    inside = _table_margin(station, feet)
    stands = (inside >= radius) | (inside <= -(station.pedestal_radius_m + EDGE_GAP_M))
    for outline in station.outlines:
        stands &= _outline_distance(outline, feet) >= radius + ELBOW_MARGIN_M
    return stands


def _table_margin(station: Station, feet: Points2) -> np.ndarray:
    """How far inside the edges of the table each foot is, negative outside. Shape (n,) [m]."""
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
    margin: np.ndarray = np.where(outside > 0.0, -outside, -beyond.max(axis=1))
    return margin


def _outline_distance(outline: Points2, feet: Points2) -> np.ndarray:
    """Distance from each foot to a convex outline, 0 inside. Shape (n,) [m]."""
    start, edge = outline, np.roll(outline, -1, axis=0) - outline
    offset = feet[:, None] - start[None]
    share = np.clip((offset * edge).sum(2) / np.maximum((edge * edge).sum(1), 1e-18), 0.0, 1.0)
    distance = np.linalg.norm(offset - share[..., None] * edge, axis=2).min(axis=1)
    cross = edge[None, :, 0] * offset[..., 1] - edge[None, :, 1] * offset[..., 0]
    return np.where((cross >= 0.0).all(axis=1), 0.0, distance)


def _arm_touches(station: Station, data: mujoco.MjData) -> bool:
    """Whether any contact of the home configuration, which the data are in, involves the arm."""
    mujoco.mj_fwdPosition(station.model, data)
    bodies = station.model.geom_bodyid[data.contact.geom]
    return bool(np.isin(bodies, station.arm_bodies).any())
