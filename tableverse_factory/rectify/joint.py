"""Joint rectification: the whole layout moves as little as it can, and who carries whom stays."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float64

from schemas.config import RectifyConfig
from schemas.geometry import Vector3
from tableverse_factory.geometry.clearance import Ray
from tableverse_factory.geometry.least_motion import least_motion, least_violation
from tableverse_factory.geometry.separation import UPRIGHT_STRETCH, Plane, Separator
from tableverse_factory.rectify.groups import Group, components, ground
from tableverse_factory.rectify.lccr import Rectified
from tableverse_factory.rectify.parts import Part
from tableverse_factory.rectify.radial import radial_order, spread
from tableverse_factory.rectify.support import Support, read_support
from tableverse_factory.rectify.vertical import UP

Offsets = Float64[np.ndarray, "n 3"]

SIDEWAYS_M, UPWARD_M = 0.007, 0.003
"""Motions of these lengths weigh the same: about the noise of registration [m]."""
REACH_M = 0.012
"""No object moves further than half of this in one step; what is further apart cannot meet in it [m]."""
STEPS = 12
CONVERGED_M = 1e-5
EXTRA_M = 2e-6
"""Kept on top of the clearance while moving, so that the exact clean-up finds nothing to do [m]."""
SOFTNESS = 0.05
UNIT_M = 1e-3
"""Lengths in the least-distance problems are of order one."""


def joint(parts: Sequence[Part], config: RectifyConfig) -> Rectified:
    """Moves parts until none is nearer to another than the clearance, all of them together and as little as possible.

    The result depends on ids and geometry, not on the order of `parts`.
    """
    order = sorted(range(len(parts)), key=lambda i: parts[i].object_id)
    given = [parts[i] for i in order]
    support = read_support(given, config.contact_m)
    near = _Layout(given, support, config.clearance_m).rectified()
    trees: list[Group] = [tuple((i,) for i in tree) for tree in components(sorted(support.pairs), len(given))]
    freed = _lowered(_spread(_raised(near, support, config.clearance_m), trees, config), support, config.clearance_m)
    ordered = radial_order(given, trees)
    back = {i: k for k, i in enumerate(order)}
    return Rectified(
        tuple(freed[back[i]] for i in range(len(parts))),
        tuple(tuple(tuple(order[i] for i in entity) for entity in members) for members in ordered),
    )


class _Layout:
    """The layout as a sequence of least-distance problems."""

    def __init__(self, parts: Sequence[Part], support: Support, clearance_m: float) -> None:
        self._parts, self._support = parts, support
        self._clearance = clearance_m + EXTRA_M
        self._any_way, self._sideways = Separator(1.0), Separator(UPRIGHT_STRETCH)
        self._free = _free_axes(support)
        self._weights = np.tile([SIDEWAYS_M, SIDEWAYS_M, UPWARD_M], len(parts))
        self._home = np.array([part.body.offset for part in parts])
        for i, standing in enumerate(support.standing):
            if standing:
                self._home[i, 2] -= parts[i].lowest_now_m

    def rectified(self) -> list[Part]:
        """Where the layout ends; free of overlaps unless the steps ran out."""
        at = self._home
        for _ in range(STEPS):
            planes = self._planes(at)
            after = self._step(at, planes)
            violation = max((-plane.spare_m for _, _, plane in planes), default=0.0)
            if violation <= CONVERGED_M and np.abs(after - at).max() <= CONVERGED_M:
                break
            at = after
        return self._at(at)

    def _at(self, offsets: Offsets) -> list[Part]:
        return [
            replace(part, body=replace(part.body, offset=offset))
            for part, offset in zip(self._parts, offsets, strict=True)
        ]

    def _planes(self, at: Offsets) -> list[tuple[int, int, Plane]]:
        bodies = [part.body for part in self._at(at)]
        found: list[tuple[int, int, Plane]] = []
        for i, j in combinations(range(len(bodies)), 2):
            rise = 1.0 if (i, j) in self._support.pairs else -1.0 if (j, i) in self._support.pairs else 0.0
            separator = self._any_way if rise else self._sideways

            def instead(direction: Vector3, rise: float = rise) -> Vector3:
                return rise * UP if rise * direction[2] < -0.1 else direction

            planes = separator.planes(bodies[i], bodies[j], self._clearance, REACH_M, instead)
            found.extend((i, j, plane) for plane in planes)
        return found

    def _step(self, at: Offsets, planes: Sequence[tuple[int, int, Plane]]) -> Offsets:
        """The offsets nearest to home that every plane allows."""
        rows, bounds = self._rows(at, planes)
        scaled = (rows * self._weights)[:, self._free]
        needed = (bounds - rows @ self._home.ravel()) / UNIT_M
        scaled = scaled / UNIT_M
        moving = np.linalg.norm(scaled, axis=1) > 1e-9
        scaled, needed = scaled[moving], needed[moving]
        motion = least_motion(scaled, needed)
        if motion is None:
            motion = least_violation(scaled, needed, SOFTNESS)
        offsets = self._home.ravel().copy()
        offsets[self._free] += motion * self._weights[self._free]
        return offsets.reshape(-1, 3)

    def _rows(
        self, at: Offsets, planes: Sequence[tuple[int, int, Plane]]
    ) -> tuple[Float64[np.ndarray, "m n"], Float64[np.ndarray, " m"]]:
        """`rows @ offsets >= bounds`: planes between pieces, the table, and how far a step may go."""
        count = at.size
        rows, bounds = np.zeros((len(planes), count)), np.zeros(len(planes))
        for k, (i, j, plane) in enumerate(planes):
            rows[k, 3 * i : 3 * i + 3] = plane.direction
            rows[k, 3 * j : 3 * j + 3] = -plane.direction
            bounds[k] = rows[k] @ at.ravel() - plane.spare_m
        table = np.eye(count)[2::3]
        on_table = np.array([-part.lowest_m for part in self._parts])
        trust = np.concatenate([np.eye(count), -np.eye(count)])
        within = trust @ at.ravel() - REACH_M / 2
        return np.concatenate([rows, table, trust]), np.concatenate([bounds, on_table, within])


def _free_axes(support: Support) -> Bool[np.ndarray, " n"]:
    """What stands on the table keeps its height."""
    free = np.ones((len(support.standing), 3), dtype=bool)
    free[:, 2] = ~np.array(support.standing)
    return free.ravel()


def _raised(parts: Sequence[Part], support: Support, clearance_m: float) -> list[Part]:
    """Parts lifted, the lowest first, out of those of their tree that were before them."""
    ray, lifted = Ray(UP), list(parts)
    settled: list[int] = []
    for i in upward(parts, support):
        height = ray.first_clear([lifted[i].body], [lifted[k].body for k in settled], clearance_m)
        lifted[i] = lifted[i].moved(height * UP)
        settled.append(i)
    return lifted


def _spread(parts: Sequence[Part], trees: Sequence[Group], config: RectifyConfig) -> list[Part]:
    grounded = ground(parts, trees)
    return spread(grounded, radial_order(grounded, trees), config.clearance_m)


def _lowered(parts: Sequence[Part], support: Support, clearance_m: float) -> list[Part]:
    """Parts let down, the lowest first, until they meet the table or another part."""
    ray, lowered = Ray(-UP), list(parts)
    for i in upward(parts, support):
        others = [part.body for k, part in enumerate(lowered) if k != i]
        depth = ray.room([lowered[i].body], others, clearance_m, lowered[i].lowest_now_m)
        lowered[i] = lowered[i].moved(-depth * UP)
    return lowered


def upward(parts: Sequence[Part], support: Support) -> list[int]:
    """Indices such that carriers come before what they carry, as far as that has an end; then by height and id."""
    rank = sorted(range(len(parts)), key=lambda i: (not support.standing[i], parts[i].lowest_now_m, parts[i].object_id))
    done: list[int] = []
    while rank:
        ready = [i for i in rank if all(low in done for up, low in support.pairs if up == i)]
        done.append(ready[0] if ready else rank[0])
        rank.remove(done[-1])
    return done
