"""Antipodal grasps: pairs of contacts whose normals lie in the friction cone about the line between them.

From points spread over the surface, rays go inwards within the friction cone (Nguyen 1988; Mahler et al. 2017 sample
in the same way). Each ray gives up to two partners: where it first leaves the body (a pinched wall) and where it last
leaves it (the whole body, enclosed). Each pair is approached from several sides and to several depths.
"""

from dataclasses import dataclass

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Frozen, Points, TriangleMesh, Vector3
from schemas.trajectories import Grasps, Numbers
from tableverse_factory.geometry.mesh.raycasting import RaycastingScene, make_raycasting_scene
from tableverse_factory.geometry.relations.antipodal import (
    FRICTION,
    cast_surface_rays,
    compute_outward_sign,
    sample_inward_normals,
)
from tableverse_factory.robotics.grasps.clearance import TABLE_CLEARANCE_M
from tableverse_factory.robotics.grasps.closing import Rotations, close_pads
from tableverse_factory.robotics.robots.arm import GripperShape
from tableverse_factory.robotics.robots.gripper_clearance import FINGER_CLEARANCE_M

OPENING_MARGIN_M = 0.002  # A gripped object is at least this much narrower than the opening: 0.078 m for a Panda's hand
# Rotations of the approach about the closing axis, from the steepest descent that the axis allows [rad]
ROLLS = np.radians([0.0, -20.0, 20.0, -40.0, 40.0, -60.0, 60.0, -80.0, 80.0])
# Travel of the TCP beyond the contacts: grips with the middle of the pads, or with the fingertips
DEPTHS_M = (0.0, -0.008)
MAX_LIFTED_M = 0.012  # maximum retreat of the gripper where its fingertips would touch the table
MAX_PAIRS = 128  # contact pairs that are examined closely, spread over the body
# Slopes beyond the friction cone, up to this coefficient, may still hold: used when nothing better is found
LOOSE_FRICTION = 0.75
# Weights of slope, nearness of the center of mass, and area in the score; and the score's factor on loose slopes
_WEIGHTS, _LOOSE_FACTOR = (0.25, 0.4, 0.35), 0.3
_HALF_SCORE_LEVER_M = 0.04  # at this distance from the center of mass nearness is one half
# Pairs in one cell count as one; parts of a body have this size; widths of one kind differ by less than this
_CELL_M, _PART_M, _KIND_M = 0.012, 0.06, 0.02
_CLOSING_START_M = 0.012  # pads begin to close this far outside their contacts
_MIN_WIDTH_M, _SLACK_M = 0.001, 0.0005


@dataclass(frozen=True, slots=True, eq=False)
class _ContactPairs(Frozen):
    """Antipodal pairs of contacts."""

    first: Points  # contact of the finger on the negative side of the axis [m]
    axis: Points  # unit vectors to the other contact
    width: Numbers  # between the contacts [m]
    alignment: Numbers  # 0 where a normal is on the rim of the friction cone, 1 where both are on the axis

    def middle(self) -> Points:
        return self.first + 0.5 * self.width[:, None] * self.axis

    def select(self, kept: np.ndarray) -> "_ContactPairs":
        return _ContactPairs(self.first[kept], self.axis[kept], self.width[kept], self.alignment[kept])


def sample_antipodal_grasps(
    mesh: TriangleMesh,
    felt: TriangleMesh,
    gripper: GripperShape,
    max_opening_m: float,
    center: Vector3,
    config: TrajectoriesConfig,
    rng: np.random.Generator,
) -> Grasps:
    """Sample grasps of one isolated body in the table frame, best score first.

    The score, 0 to 1, weighs how well the normals oppose each other, nearness to the center of mass, and the share of
    the pads that presses on something from both sides. It ignores the approach direction (see `grasps.arbitration`).
    `felt` are the convex pieces, which a simulation collides, as one mesh; `config.candidates` is the number of rays.
    """
    opening = max_opening_m - OPENING_MARGIN_M
    pairs = _keep_above_table(_find_contact_pairs(mesh, config.candidates, opening, rng), gripper)
    pairs = _spread_pairs(pairs, _score_nearness(pairs.middle(), center))
    return _generate_approaches(pairs, make_raycasting_scene(felt), center, gripper, opening)


def _find_contact_pairs(mesh: TriangleMesh, count: int, opening: float, rng: np.random.Generator) -> _ContactPairs:
    """Find all pairs within the opening [m] and within the friction cone."""
    caster, sign = make_raycasting_scene(mesh), compute_outward_sign(mesh)
    points, inward = sample_inward_normals(mesh, count)
    inward = sign * inward
    ways = _sample_cone_directions(inward, rng)
    edge, found = _compute_cone_cosine(FRICTION), []
    walls = cast_surface_rays(caster, points, ways, sign)
    back, last = cast_surface_rays(caster, points + opening * ways, -ways, sign)  # back from beyond the opening
    for width, normals in (walls, (opening - back, last)):
        slopes = np.minimum(np.einsum("ij,ij->i", inward, ways), np.einsum("ij,ij->i", normals, ways))
        good = (width >= _MIN_WIDTH_M) & (width <= opening) & (slopes >= edge)
        alignment = (slopes[good] - edge) / (1.0 - edge)
        found.append((points[good], ways[good], width[good], alignment))
    return _ContactPairs(*map(np.concatenate, zip(*found, strict=True)))


def _sample_cone_directions(inward: Points, rng: np.random.Generator) -> Points:
    """Choose a direction in each normal's friction cone: the normal, the most level one, or a random one, in turn.

    Level directions find thin objects that lie flat, which random directions would rarely hit.
    """
    edge = _compute_cone_cosine(FRICTION)
    slope = 1.0 - rng.random(len(inward)) * (1.0 - edge)
    slope[::3] = 1.0
    turn = 2 * np.pi * rng.random(len(inward))
    side, other = _compute_tangents(inward)
    tilt = np.sqrt(1.0 - slope**2)[:, None]
    ways: Points = slope[:, None] * inward + tilt * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other)
    flat = np.hypot(inward[:, 0], inward[:, 1])
    level = np.flatnonzero((np.arange(len(inward)) % 3 == 1) & (flat > edge))
    ways[level] = np.concatenate([inward[level, :2] / flat[level, None], np.zeros((len(level), 1))], axis=1)
    return ways


def _compute_cone_cosine(friction: float) -> float:
    """Compute the cosine between the axis of a friction cone and its surface."""
    return float(1.0 / np.sqrt(1.0 + friction**2))


def _compute_tangents(axes: Points) -> tuple[Points, Points]:
    """Compute two unit vectors across each axis; the first is level where the axis allows it."""
    level = np.stack([-axes[:, 1], axes[:, 0], np.zeros(len(axes))], axis=1)
    upright = np.abs(axes[:, 2]) > 1.0 - 1e-9
    level[upright] = [1.0, 0.0, 0.0]
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    return level, np.cross(axes, level)


def _score_nearness(middle: Points, center: Vector3) -> Numbers:
    """Score 1 where the center of mass hangs below the grasp, falling with the lever of its weight."""
    across = np.hypot(middle[:, 0] - center[0], middle[:, 1] - center[1])
    above = 0.5 * np.maximum(center[2] - middle[:, 2], 0.0)  # what is held below its centre wants to topple
    return 1.0 / (1.0 + np.hypot(across, above) / _HALF_SCORE_LEVER_M)


def _keep_above_table(pairs: _ContactPairs, gripper: GripperShape) -> _ContactPairs:
    """Drop pairs of which a finger would be in the table whatever the approach."""
    thickness = float((gripper.finger_centers + gripper.finger_half_sizes)[:, 1].max())
    lowest = pairs.middle()[:, 2] - np.abs(pairs.axis[:, 2]) * (0.5 * pairs.width + thickness)
    return pairs.select(lowest >= TABLE_CLEARANCE_M - MAX_LIFTED_M * (1.0 - np.abs(pairs.axis[:, 2])))


def _spread_pairs(pairs: _ContactPairs, nearness: Numbers) -> _ContactPairs:
    """Select the best pair per place and direction, then the best `MAX_PAIRS` from all parts of the body in turn.

    Parts differ in position and width, as the best pair alone may be out of reach or out of room.
    """
    order = np.argsort(-(pairs.alignment + nearness), kind="stable")
    axis = pairs.axis * np.where(pairs.axis @ [1.0, 1e-3, 1e-6] < 0.0, -1.0, 1.0)[:, None]  # closing is symmetric
    places = np.floor(pairs.middle() / _CELL_M).astype(np.int64)
    keys = np.concatenate([places, np.rint(2.0 * axis).astype(np.int64)], axis=1)[order]
    _, first = np.unique(keys, axis=0, return_index=True)
    order = order[np.sort(first)]
    parts = np.column_stack([pairs.middle()[order] / _PART_M, pairs.width[order] / _KIND_M])
    _, part = np.unique(np.floor(parts).astype(np.int64), axis=0, return_inverse=True)
    together = np.argsort(part, kind="stable")
    begins = np.searchsorted(part[together], part[together])
    rank = np.empty(len(order), dtype=np.int64)
    rank[together] = np.arange(len(order)) - begins
    return pairs.select(order[np.argsort(rank, kind="stable")][:MAX_PAIRS])


def _generate_approaches(
    pairs: _ContactPairs, felt: RaycastingScene, center: Vector3, gripper: GripperShape, opening: float
) -> Grasps:
    """Approach every pair from every side and to every depth where the gripper clears the table and finds hold."""
    level, steep = _compute_tangents(pairs.axis)
    steep = np.where(steep[:, 2:] > 0.0, -steep, steep)
    approach = np.concatenate([np.cos(roll) * steep + np.sin(roll) * level for roll in ROLLS])
    pair = np.tile(np.arange(len(pairs.width)), len(ROLLS))
    axis, middle = pairs.axis[pair], pairs.middle()[pair]
    rotation = np.stack([np.cross(axis, approach), axis, approach], axis=2)
    kept, depth = _choose_depths(gripper, rotation, middle, pairs.width[pair])
    rotation, nearness = rotation[kept], _score_nearness(pairs.middle(), center)[pair[kept]]
    position = middle[kept] + depth[:, None] * rotation[:, :, 2]
    found = close_pads(rotation, position, pairs.width[pair[kept]] + 2 * _CLOSING_START_M, felt, gripper)
    edge, loose = _compute_cone_cosine(FRICTION), _compute_cone_cosine(LOOSE_FRICTION)
    good = (found.width >= _MIN_WIDTH_M) & (found.width <= opening) & (found.slope >= loose)
    firm = np.clip((found.slope - edge) / (1.0 - edge), 0.0, 1.0)
    scores = np.stack([firm, nearness, found.share], axis=1) @ np.array(_WEIGHTS)
    scores *= np.where(found.slope >= edge, 1.0, _LOOSE_FACTOR)
    position = position + np.where(good, found.sideways, 0.0)[:, None] * rotation[:, :, 1]
    best = np.flatnonzero(good)
    best = best[np.argsort(-scores[best], kind="stable")]
    return Grasps(rotation[best], position[best], found.width[best], scores[best])


def _choose_depths(
    gripper: GripperShape, rotation: Rotations, middle: Points, width: Numbers
) -> tuple[np.ndarray, Numbers]:
    """Return the approaches that can be followed to some depth above the table, and the depths [m]."""
    kept, depths = [], []
    last = np.full(len(middle), np.inf)
    for wanted in DEPTHS_M:
        back = _compute_retreat(gripper, rotation, middle + wanted * rotation[:, :, 2], width)
        depth = wanted - back
        good = (back <= MAX_LIFTED_M) & (depth < last - 1e-6)
        last = np.where(good, depth, last)
        kept.append(np.flatnonzero(good))
        depths.append(depth[good])
    return np.concatenate(kept), np.concatenate(depths)


def _compute_retreat(gripper: GripperShape, rotation: Rotations, position: Points, width: Numbers) -> Numbers:
    """Compute how far each gripper must retreat for its open fingers to stay above the table [m]."""
    down, approach = rotation[:, 2], rotation[:, 2, 2]
    deepest = (down @ gripper.finger_centers.T - np.abs(down) @ gripper.finger_half_sizes.T).min(axis=1)
    mirrored = (down * [1.0, -1.0, 1.0]) @ gripper.finger_centers.T - np.abs(down) @ gripper.finger_half_sizes.T
    deepest = np.minimum(deepest, mirrored.min(axis=1)) - np.abs(down[:, 1]) * (0.5 * width + FINGER_CLEARANCE_M)
    return np.maximum(TABLE_CLEARANCE_M + _SLACK_M - position[:, 2] - deepest, 0.0) / np.maximum(-approach, 1e-3)
