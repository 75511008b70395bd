"""Can the task be done? One answer, with its reason, for the rules' own tasks and for those of a model."""

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

MIN_GRIP_SHARE = 0.01
"""Share of surface points with an antipodal partner, below which a thing counts as not graspable."""

MIN_FREE_GRIPS = 2
_SAME = {Relation.INTO: Relation.IN, Relation.INSIDE: Relation.IN}


class Feasibility:
    """What can be done in one scene; remembers what it has measured.

    Args:
        meshes: Each object as it stands, table frame [m].
        grips: Where a gripper can take hold of each.
        scene: The objects on their table.
        max_mass_kg: What the gripper lifts.
    """

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

    def graspable(self, x: int, mass_kg: float) -> bool:
        """Whether the object by itself suits the gripper: an antipodal grip within its opening, and its weight."""
        return self._grips[x].share >= MIN_GRIP_SHARE and mass_kg <= self._max_mass

    def pick_refusal(self, x: int, mass_kg: float) -> str:
        """Why the object of this mass cannot be picked up where it is; empty if it can."""
        if x not in self._pick_refusals:
            self._pick_refusals[x] = self._explain_pick_refusal(x)
        return self._pick_refusals[x] or ("too_heavy" if mass_kg > self._max_mass else "")

    def refusal(self, relation: Relation, x: int, y: int, mass_kg: float) -> str:
        """Why `x`, of this mass, cannot be picked up and placed in this relation to `y`; empty if it can."""
        if relation_holds(relation, self._scene.bodies[x], self._scene.bodies[y]):
            return "already_holds"
        key = (_SAME.get(relation, relation), x, y)
        refusal = self.pick_refusal(x, mass_kg)
        if not refusal and key not in self._place_refusals:
            self._place_refusals[key] = self._explain_place_refusal(*key)
        return refusal or self._place_refusals[key]

    def _explain_place_refusal(self, relation: Relation, x: int, y: int) -> str:
        reference = self._scene.bodies[y]
        if relation is Relation.IN and reference.cavity is None:
            return "no_container"
        poses = self._turn_body(x) if relation is Relation.IN else ()
        heights = self._heights_without(x)
        if find_placement(relation, self._scene.bodies[x], reference, self._scene, heights, poses) is not None:
            return ""
        return "no_stable_top" if relation is Relation.ON else "no_room"

    def _explain_pick_refusal(self, x: int) -> str:
        if self._grips[x].share < MIN_GRIP_SHARE:
            return "not_graspable"
        mine = self._scene.bodies[x]
        for other, body in enumerate(self._scene.bodies):
            if other != x and (rests_on(body, mine) or is_inside(body, mine)):
                return "carries_others"
        return "" if self._count_free_grips(x) >= MIN_FREE_GRIPS else "out_of_reach"

    def _count_free_grips(self, x: int) -> int:
        """Grips with room for both fingers from above."""
        fingers = self._grips[x].fingers()
        heights = self._heights_without(x)
        index = np.floor(fingers[..., :2] / self._scene.cell).astype(int) - np.array(self._scene.corner)
        index = np.clip(index, 0, np.array(heights.shape) - 1)
        ground = heights[index[..., 0], index[..., 1]]
        # Beyond the table's edge there is air: a finger may hang over it.
        blocked = np.isfinite(ground) & (ground > fingers[..., 2])
        return int((~blocked).all(axis=1).sum())

    def _turn_body(self, x: int) -> tuple[BodyFeatures, ...]:
        """The object turned by a quarter about the vertical, and stood on its end where it is long."""
        if x not in self._turned:
            on_end = stand_upright(self._meshes[x])
            turned: tuple[BodyFeatures, ...] = (rotate_body_quarter_turn(self._scene.bodies[x]),)
            if on_end is not None:
                turned += (compute_body_features(on_end, cell=self._scene.cell),)
            self._turned[x] = turned
        return self._turned[x]
