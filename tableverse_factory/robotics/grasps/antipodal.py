"""Antipodal grasps: pairs of contacts whose normals lie in the friction cone about the line between them.

From points spread over the surface, rays go inwards within the friction cone (Nguyen 1988; Mahler et al. 2017 sample
in the same way). Each ray gives up to two partners: where it first leaves the body (a wall, pinched) and where it
leaves it for good (the whole body, enclosed). Each pair is approached from several sides and to several depths.
"""

from dataclasses import dataclass

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Frozen, Points, TriangleMesh, Vector3
from schemas.trajectories import Grasps, Numbers
from tableverse_factory.geometry.mesh.height_maps import Caster, column_caster
from tableverse_factory.geometry.relations.antipodal import FRICTION, first_hits, outward_sign, surface_points
from tableverse_factory.robotics.grasps.clearance import TABLE_M
from tableverse_factory.robotics.grasps.closing import Rotations, hold
from tableverse_factory.robotics.robots.arm import GripperShape
from tableverse_factory.robotics.robots.gripper_clearance import FINGER_ROOM_M

OPENING_MARGIN_M = 0.002
"""What is gripped is at least this narrower than the opening: 0.078 m for a Panda's hand."""

ROLLS = np.radians([0.0, -20.0, 20.0, -40.0, 40.0, -60.0, 60.0, -80.0, 80.0])
"""Turns of the approach about the closing axis, from the steepest descent that the axis allows [rad]."""

DEPTHS_M = (0.0, -0.008)
"""How far the TCP goes beyond the contacts: with the middle of the pads, or rather with the fingertips."""

MAX_LIFTED_M = 0.012
"""The gripper may stay back this far where its fingertips would touch the table."""

MAX_PAIRS = 128
"""Pairs of contacts that are looked at closely, spread over the body."""

LOOSE_FRICTION = 0.75
"""Pads on slopes beyond the friction cone, up to this one, may still hold: tried when all else fails."""

_WEIGHTS, _LOOSE = (0.25, 0.4, 0.35), 0.3
"""Of slope, nearness of the centre of mass, and area, in the score; and what is left of a score on loose slopes."""

_LEVER_M = 0.04
"""At this distance the centre of mass counts half."""

_CELL_M, _PART_M, _KIND_M = 0.012, 0.06, 0.02
"""Pairs in one cell are one; parts of a body are so large, and widths of one kind differ by so much."""

_BEYOND_M = 0.012
"""Pads begin to close this far outside their contacts."""

_MIN_WIDTH_M = 0.001
_SLACK_M = 0.0005


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs(Frozen):
    """Antipodal pairs of contacts.

    Attributes:
        first: Contact of the finger on the negative side of the axis. Shape (n, 3) [m].
        axis: Unit vectors to the other contact. Shape (n, 3).
        width: Between the contacts. Shape (n,) [m].
        alignment: 0 where a normal lies on the rim of the friction cone, 1 where both lie on the axis. Shape (n,).
    """

    first: Points
    axis: Points
    width: Numbers
    alignment: Numbers

    def middle(self) -> Points:
        """Of each pair [m]."""
        middle: Points = self.first + 0.5 * self.width[:, None] * self.axis
        return middle

    def chosen(self, kept: np.ndarray) -> "_Pairs":
        return _Pairs(self.first[kept], self.axis[kept], self.width[kept], self.alignment[kept])


def sample(
    mesh: TriangleMesh,
    felt: TriangleMesh,
    gripper: GripperShape,
    max_opening_m: float,
    center: Vector3,
    config: TrajectoriesConfig,
    rng: np.random.Generator,
) -> Grasps:
    """Grasps of one body by itself, best score first; whether the gripper has room is `grasps.clearance`'s question.

    The score, 0 to 1, weighs how well the normals oppose each other, how near the grasp is to the centre of mass, and
    how much of the pads finds something to press on from both sides. It does not know where the approach comes
    from: that is the business of `grasps.arbitration`.

    Args:
        mesh: As it stands, table frame [m].
        felt: What a simulation feels in its place: its convex pieces as one mesh [m].
        gripper: Its fingers.
        max_opening_m: Widest distance between them [m].
        center: The body's centre of mass, table frame [m].
        config: `candidates` says how many rays are sent.
        rng: Turns rays away from the normals.
    """
    caster = column_caster(mesh)
    opening = max_opening_m - OPENING_MARGIN_M
    pairs = _contacts(mesh, caster, config.candidates, opening, rng)
    pairs = _above_table(pairs, gripper)
    pairs = _spread(pairs, _nearness(pairs.middle(), center))
    return _approached(pairs, column_caster(felt), center, gripper, opening)


def _contacts(mesh: TriangleMesh, caster: Caster, count: int, opening: float, rng: np.random.Generator) -> _Pairs:
    """Every pair that the rays find within the opening [m] and within the friction cone."""
    sign = outward_sign(mesh)
    points, inward = surface_points(mesh, count)
    inward = sign * inward
    ways = _within_cone(inward, rng)
    edge, found = _rim(FRICTION), []
    for width, normals in (
        first_hits(caster, points, ways, sign),
        _last_exits(caster, points, ways, sign, opening),
    ):
        slopes = np.minimum(np.einsum("ij,ij->i", inward, ways), np.einsum("ij,ij->i", normals, ways))
        good = (width >= _MIN_WIDTH_M) & (width <= opening) & (slopes >= edge)
        alignment = (slopes[good] - edge) / (1.0 - edge)
        found.append(_Pairs(points[good], ways[good], width[good], alignment))
    wall, whole = found
    fields = ("first", "axis", "width", "alignment")
    return _Pairs(*(np.concatenate([getattr(wall, name), getattr(whole, name)]) for name in fields))


def _within_cone(inward: Points, rng: np.random.Generator) -> Points:
    """A direction in the friction cone about each normal: the normal, the most level one, or any, in turn.

    On a table fingers close level: without the second kind, what is thin and lies flat would hardly be found.
    """
    edge = _rim(FRICTION)
    slope = 1.0 - rng.random(len(inward)) * (1.0 - edge)
    slope[::3] = 1.0
    turn = 2 * np.pi * rng.random(len(inward))
    side, other = _across(inward)
    tilt = np.sqrt(1.0 - slope**2)[:, None]
    ways: Points = slope[:, None] * inward + tilt * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other)
    flat = np.hypot(inward[:, 0], inward[:, 1])
    level = np.flatnonzero((np.arange(len(inward)) % 3 == 1) & (flat > edge))
    ways[level] = np.concatenate([inward[level, :2] / flat[level, None], np.zeros((len(level), 1))], axis=1)
    return ways


def _rim(friction: float) -> float:
    """Cosine between the axis of a friction cone and its surface."""
    return float(1.0 / np.sqrt(1.0 + friction**2))


def _last_exits(caster: Caster, points: Points, ways: Points, sign: float, opening: float) -> tuple[Numbers, Points]:
    """Widths and outward normals at the far side of all that lies within the opening, seen from beyond it."""
    back, normals = first_hits(caster, points + opening * ways, -ways, sign)
    return opening - back, normals


def _across(axes: Points) -> tuple[Points, Points]:
    """Two unit vectors across each axis; the first one level where the axis allows it."""
    level = np.stack([-axes[:, 1], axes[:, 0], np.zeros(len(axes))], axis=1)
    upright = np.abs(axes[:, 2]) > 1.0 - 1e-9
    level[upright] = [1.0, 0.0, 0.0]
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    return level, np.cross(axes, level)


def _nearness(middle: Points, center: Vector3) -> Numbers:
    """1 where the centre of mass hangs below the grasp, falling with the lever of its weight."""
    across = np.hypot(middle[:, 0] - center[0], middle[:, 1] - center[1])
    above = 0.5 * np.maximum(center[2] - middle[:, 2], 0.0)  # what is held below its centre wants to topple
    nearness: Numbers = 1.0 / (1.0 + np.hypot(across, above) / _LEVER_M)
    return nearness


def _above_table(pairs: _Pairs, gripper: GripperShape) -> _Pairs:
    """Without those of which a finger, behind its contact, would be in the table whatever the approach."""
    thickness = float((gripper.finger_centers + gripper.finger_half_sizes)[:, 1].max())
    lowest = pairs.middle()[:, 2] - np.abs(pairs.axis[:, 2]) * (0.5 * pairs.width + thickness)
    return pairs.chosen(lowest >= TABLE_M - MAX_LIFTED_M * (1.0 - np.abs(pairs.axis[:, 2])))


def _spread(pairs: _Pairs, nearness: Numbers) -> _Pairs:
    """The best pair of each place and direction, and of those the best `MAX_PAIRS`, from all parts of the body in turn.

    Parts differ in where they are and in how wide: what is best by itself may be out of reach or out of room.
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
    return pairs.chosen(order[np.argsort(rank, kind="stable")][:MAX_PAIRS])


def _approached(pairs: _Pairs, felt: Caster, center: Vector3, gripper: GripperShape, opening: float) -> Grasps:
    """Every pair from every side and to every depth, as far as the gripper stays above the table and finds hold."""
    level, steep = _across(pairs.axis)
    steep = np.where(steep[:, 2:] > 0.0, -steep, steep)
    approach = np.concatenate([np.cos(roll) * steep + np.sin(roll) * level for roll in ROLLS])
    pair = np.tile(np.arange(len(pairs.width)), len(ROLLS))
    axis, middle = pairs.axis[pair], pairs.middle()[pair]
    rotation = np.stack([np.cross(axis, approach), axis, approach], axis=2)
    kept, depth = _depths(gripper, rotation, middle, pairs.width[pair])
    rotation, nearness = rotation[kept], _nearness(pairs.middle(), center)[pair[kept]]
    position = middle[kept] + depth[:, None] * rotation[:, :, 2]
    found = hold(rotation, position, pairs.width[pair[kept]] + 2 * _BEYOND_M, felt, gripper)
    edge, loose = _rim(FRICTION), _rim(LOOSE_FRICTION)
    good = (found.width >= _MIN_WIDTH_M) & (found.width <= opening) & (found.slope >= loose)
    firm = np.clip((found.slope - edge) / (1.0 - edge), 0.0, 1.0)
    scores = np.stack([firm, nearness, found.share], axis=1) @ np.array(_WEIGHTS)
    scores *= np.where(found.slope >= edge, 1.0, _LOOSE)
    position = position + np.where(good, found.sideways, 0.0)[:, None] * rotation[:, :, 1]
    best = np.flatnonzero(good)
    best = best[np.argsort(-scores[best], kind="stable")]
    return Grasps(rotation[best], position[best], found.width[best], scores[best])


def _depths(gripper: GripperShape, rotation: Rotations, middle: Points, width: Numbers) -> tuple[np.ndarray, Numbers]:
    """The approaches that can be followed to some depth above the table, and the depths [m]."""
    kept, depths = [], []
    last = np.full(len(middle), np.inf)
    for wanted in DEPTHS_M:
        back = _too_low(gripper, rotation, middle + wanted * rotation[:, :, 2], width)
        depth = wanted - back
        good = (back <= MAX_LIFTED_M) & (depth < last - 1e-6)
        last = np.where(good, depth, last)
        kept.append(np.flatnonzero(good))
        depths.append(depth[good])
    return np.concatenate(kept), np.concatenate(depths)


def _too_low(gripper: GripperShape, rotation: Rotations, position: Points, width: Numbers) -> Numbers:
    """How far each gripper must go back along its approach for its open fingers to stay above the table [m]."""
    down, approach = rotation[:, 2], rotation[:, 2, 2]
    deepest = (down @ gripper.finger_centers.T - np.abs(down) @ gripper.finger_half_sizes.T).min(axis=1)
    mirrored = (down * [1.0, -1.0, 1.0]) @ gripper.finger_centers.T - np.abs(down) @ gripper.finger_half_sizes.T
    deepest = np.minimum(deepest, mirrored.min(axis=1)) - np.abs(down[:, 1]) * (0.5 * width + FINGER_ROOM_M)
    back: Numbers = np.maximum(TABLE_M + _SLACK_M - position[:, 2] - deepest, 0.0) / np.maximum(-approach, 1e-3)
    return back
