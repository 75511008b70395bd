"""Can the task be done? One answer, with its reason, for the rules' own tasks and for those of a model."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from schemas.curation import Relation
from schemas.geometry import TriangleMesh
from tableverse_factory.curate.case import Case
from tableverse_factory.geometry.height_maps import Heights
from tableverse_factory.geometry.placement import find_placement
from tableverse_factory.geometry.relations import Body, body_of, holds, is_inside, rests_on, turned_body

MIN_GRIP_SHARE = 0.01
"""Share of surface points with an antipodal partner, below which a thing counts as not graspable."""

MIN_FREE_GRIPS = 2
_LONG = 2.0
_CONTAINING = (Relation.IN, Relation.INTO, Relation.INSIDE)


class Feasibility:
    """What can be done in one scene; remembers what it has measured.

    Args:
        case: The scene.
        masses_kg: Mass of each item.
        max_mass_kg: What the gripper can lift.
    """

    def __init__(self, case: Case, masses_kg: tuple[float, ...], max_mass_kg: float) -> None:
        self._case = case
        self._masses = masses_kg
        self._max_mass = max_mass_kg
        self._heights_without: Callable[[int], Heights] = lru_cache(maxsize=8)(case.tabletop.without)
        self._pick_refusals: dict[int, str] = {}
        self._turned: dict[int, tuple[Body, ...]] = {}

    def graspable(self, x: int) -> bool:
        """Whether the object by itself suits the gripper: an antipodal grip within its opening, and its weight."""
        return self._case.items[x].grips.share >= MIN_GRIP_SHARE and self._masses[x] <= self._max_mass

    def pick_refusal(self, x: int) -> str:
        """Why the object cannot be picked up where it is; empty if it can."""
        if x not in self._pick_refusals:
            self._pick_refusals[x] = self._why_not_pick(x)
        return self._pick_refusals[x]

    def refusal(self, relation: Relation, x: int, y: int) -> str:
        """Why `x` cannot be picked up and placed in this relation to `y`; empty if it can."""
        body, reference = self._case.items[x].body, self._case.items[y].body
        if holds(relation, body, reference):
            return "already_holds"
        refusal = self.pick_refusal(x)
        if refusal:
            return refusal
        if relation in _CONTAINING and reference.cavity is None:
            return "no_container"
        heights = self._heights_without(x)
        poses = self._turned_bodies(x) if relation in _CONTAINING else ()
        if find_placement(relation, body, reference, self._case.tabletop, heights, poses) is not None:
            return ""
        return "no_stable_top" if relation is Relation.ON else "no_room"

    def _why_not_pick(self, x: int) -> str:
        item = self._case.items[x]
        if item.grips.share < MIN_GRIP_SHARE:
            return "not_graspable"
        if self._masses[x] > self._max_mass:
            return "too_heavy"
        for other, body in enumerate(self._case.bodies):
            if other != x and (rests_on(body, item.body) or is_inside(body, item.body)):
                return "carries_others"
        return "" if self._free_grips(x) >= MIN_FREE_GRIPS else "out_of_reach"

    def _free_grips(self, x: int) -> int:
        """Grips with room for both fingers from above."""
        fingers = self._case.items[x].grips.fingers()
        scene, heights = self._case.tabletop, self._heights_without(x)
        index = np.floor(fingers[..., :2] / scene.cell).astype(int) - np.array(scene.corner)
        index = np.clip(index, 0, np.array(heights.shape) - 1)
        ground = heights[index[..., 0], index[..., 1]]
        # Beyond the table's edge there is air: a finger may hang over it.
        blocked = np.isfinite(ground) & (ground > fingers[..., 2])
        return int((~blocked).all(axis=1).sum())

    def _turned_bodies(self, x: int) -> tuple[Body, ...]:
        """The object turned by a quarter about the vertical, and stood on its end where it is long."""
        if x not in self._turned:
            item = self._case.items[x]
            on_end = stood_on_end(item.mesh)
            turned: tuple[Body, ...] = (turned_body(item.body),)
            if on_end is not None:
                turned += (body_of(on_end, cell=self._case.tabletop.cell),)
            self._turned[x] = turned
        return self._turned[x]


def stood_on_end(mesh: TriangleMesh) -> TriangleMesh | None:
    """The mesh turned so that its longest axis is vertical, standing at z = 0; None where no axis stands out."""
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    centered = mesh.vertices - middle
    values, axes = np.linalg.eigh(centered.T @ centered)
    if values[2] <= _LONG**2 * values[1]:
        return None
    vertices = centered @ (axes * np.sign(np.linalg.det(axes)))
    vertices[:, 2] -= vertices[:, 2].min()
    return TriangleMesh(vertices + middle * [1.0, 1.0, 0.0], mesh.faces)
