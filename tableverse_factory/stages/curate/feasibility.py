"""Feasibility of pick-and-place tasks, with a reason for each refusal; for the tasks of rules and of models."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from schemas.curation import Relation
from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.mesh.height_maps import Heights
from tableverse_factory.geometry.relations.antipodal import Grips
from tableverse_factory.geometry.relations.relations import (
    BodyFeatures,
    compute_body_features,
    is_inside,
    relation_holds,
    rests_on,
    rotate_body_quarter_turn,
)
from tableverse_factory.geometry.relations.stable_placement import SupportSurface, find_placement
from tableverse_factory.geometry.relations.stand_upright import stand_upright

MIN_GRIP_SHARE = 0.01  # share of surface points with an antipodal partner below which an object is not graspable
MIN_FREE_GRIPS = 2
_SAME = {Relation.INTO: Relation.IN, Relation.INSIDE: Relation.IN}


class Feasibility:
    """Tests of tasks in one scene, with a cache of what they measure; meshes are settled, in the table frame [m]."""

    def __init__(
        self, meshes: tuple[TriangleMesh, ...], grips: tuple[Grips, ...], scene: SupportSurface, max_mass_kg: float
    ) -> None:
        self._meshes = meshes
        self._grips = grips
        self._scene = scene
        self._max_mass = max_mass_kg
        self._heights_without: Callable[[int], Heights] = lru_cache(maxsize=8)(scene.without)
        self._pick_refusals: dict[int, str] = {}
        self._place_refusals: dict[tuple[Relation, int, int], str] = {}
        self._turned: dict[int, tuple[BodyFeatures, ...]] = {}

    def is_graspable(self, x: int, mass_kg: float) -> bool:
        """Whether the isolated object suits the gripper: a grip within its opening, and its mass."""
        return self._grips[x].share >= MIN_GRIP_SHARE and mass_kg <= self._max_mass

    def explain_pick_refusal(self, x: int, mass_kg: float) -> str:
        """Explain why the object of this mass cannot be picked up where it stands; empty if it can."""
        if x not in self._pick_refusals:
            self._pick_refusals[x] = self._find_pick_obstacle(x)
        return self._pick_refusals[x] or ("too_heavy" if mass_kg > self._max_mass else "")

    def explain_refusal(self, relation: Relation, x: int, y: int, mass_kg: float) -> str:
        """Explain why `x`, of this mass, cannot be picked up and placed in this relation to `y`; empty if it can."""
        if relation_holds(relation, self._scene.bodies[x], self._scene.bodies[y]):
            return "already_holds"
        key = (_SAME.get(relation, relation), x, y)
        refusal = self.explain_pick_refusal(x, mass_kg)
        if not refusal and key not in self._place_refusals:
            self._place_refusals[key] = self._find_place_obstacle(*key)
        return refusal or self._place_refusals[key]

    def _find_place_obstacle(self, relation: Relation, x: int, y: int) -> str:
        reference = self._scene.bodies[y]
        if relation is Relation.IN and reference.cavity is None:
            return "no_container"
        poses = self._turn_body(x) if relation is Relation.IN else ()
        heights = self._heights_without(x)
        if find_placement(relation, self._scene.bodies[x], reference, self._scene, heights, poses) is not None:
            return ""
        return "no_stable_top" if relation is Relation.ON else "no_room"

    def _find_pick_obstacle(self, x: int) -> str:
        if self._grips[x].share < MIN_GRIP_SHARE:
            return "not_graspable"
        body_x, others = self._scene.bodies[x], (b for i, b in enumerate(self._scene.bodies) if i != x)
        if any(rests_on(body, body_x) or is_inside(body, body_x) for body in others):
            return "carries_others"
        return "" if self._count_free_grips(x) >= MIN_FREE_GRIPS else "out_of_reach"

    def _count_free_grips(self, x: int) -> int:
        fingers = self._grips[x].fingers()
        heights = self._heights_without(x)
        index = np.floor(fingers[..., :2] / self._scene.cell).astype(int) - np.array(self._scene.corner)
        index = np.clip(index, 0, np.array(heights.shape) - 1)
        ground = heights[index[..., 0], index[..., 1]]
        # Beyond the table's edge there is air: a finger may hang over it.
        blocked = np.isfinite(ground) & (ground > fingers[..., 2])
        return int((~blocked).all(axis=1).sum())

    def _turn_body(self, x: int) -> tuple[BodyFeatures, ...]:
        """Turn the object by a quarter about the vertical, and stand it on its end where it is long."""
        if x not in self._turned:
            on_end = stand_upright(self._meshes[x])
            standing = () if on_end is None else (compute_body_features(on_end, cell=self._scene.cell),)
            self._turned[x] = (rotate_body_quarter_turn(self._scene.bodies[x]), *standing)
        return self._turned[x]
