"""Fill one container: drop contents into it one by one, then settle them together."""

from collections.abc import Sequence
from itertools import islice

import numpy as np

from schemas.config import Config
from tableverse_factory.geometry.collision.linear_sweep import MovingSolid
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose
from tableverse_factory.geometry.relations.containers import HollowVessel, make_hollow_vessel
from tableverse_factory.geometry.relations.support import meshes_touch
from tableverse_factory.physics.simulate.at_rest import Rest
from tableverse_factory.physics.simulate.freefall import simulate_fall
from tableverse_factory.stages.rectify.drop_contents import (
    BUDGET_SPENT,
    CompositeMember,
    SimulationBudget,
    Surroundings,
    draw_random_start,
    find_seen_starts,
)

SEEN_TRIES, RANDOM_TRIES = 8, 3  # falls from starts near the seen pose, and from random ones
SLACK_M = 1e-4  # gap that free fall keeps beyond the clearance; contacts yield by a fifth of this
FREED_TRIES = 2  # tries of settling all contents together; each starts from standstill
LEFT = "left its container when everything in it was freed together"
RESTLESS = "did not come to rest when everything in its container was freed together"
UNSTABLE = "the simulation broke down when everything in its container was freed together"


class ContainerFilling:
    """An outermost container (`root`), which stands still, and its contents, in the order in which they went in."""

    def __init__(
        self, root: CompositeMember, config: Config, rng: np.random.Generator, budget: SimulationBudget
    ) -> None:
        self.members: dict[str, CompositeMember] = {root.item.object_id: root}
        self._root = root.item.object_id
        self._rectify, self._timestep_s = config.rectify, config.settle.timestep_s
        self._rng, self._budget = rng, budget
        self._solids: dict[str, tuple[CompositeMember, MovingSolid]] = {}

    def holder(self, container_id: str) -> HollowVessel:
        """Make the container at its current pose."""
        return make_hollow_vessel(self.members[container_id].mesh)

    def put(self, member: CompositeMember, holder: HollowVessel) -> bool:
        """Drop an object into the container from near its pose; returns whether it came to lie inside."""
        starts = find_seen_starts(member, self._surroundings(), holder)
        return any(self._fell_in(start, holder) for start in islice(starts, SEEN_TRIES)) or self.pour(member, holder)

    def pour(self, member: CompositeMember, holder: HollowVessel) -> bool:
        """Drop an object into the container from random starts; returns whether it came to lie inside."""
        around = self._surroundings()
        tries = (_ for _ in range(RANDOM_TRIES) if self._budget.may_drop)
        starts = (draw_random_start(member, around, holder, self._rng) for _ in tries)
        return any(self._fell_in(start, holder, slippery=True) for start in starts)

    def relax(self) -> dict[str, str]:
        """Settle all contents together until they rest in their containers; returns those taken out, with reasons."""
        lost: dict[str, str] = {}
        while (loose := self._loose()) and (lost or len(loose) > 1):  # a single one is at rest already
            out = self._freed(loose)
            if not out:
                break
            for name in out:
                self._remove(name)
            lost |= out
        return lost

    def _freed(self, loose: list[CompositeMember]) -> dict[str, str]:
        """Settle contents together; returns those that have to be taken out, with the reason."""
        for _ in range(FREED_TRIES):
            if self._budget.freeing_s <= 0.0:
                return {member.item.object_id: BUDGET_SPENT for member in loose}
            rest = self._fallen([self.members[self._root]], loose)
            self._budget.freeing_s -= rest.time_s
            if rest.warnings:
                return {loose[-1].item.object_id: UNSTABLE}  # the last that went in is the first suspect
            loose = [member.at(pose) for member, pose in zip(loose, rest.poses, strict=True)]
            self.members.update((member.item.object_id, member) for member in loose)
            if gone := self._gone():
                return dict.fromkeys(gone, LEFT)
            if rest.at_rest:
                return {}
        return {member.item.object_id: RESTLESS for member, moves in zip(loose, rest.moving, strict=True) if moves}

    def _surroundings(self) -> Surroundings:
        solids = [self._solid(member) for member in self.members.values()]
        return Surroundings(solids, self._rectify.clearance_m, self._budget)

    def _solid(self, member: CompositeMember) -> MovingSolid:
        """Make the pieces of a member once per pose, with the shapes that distance queries make of them."""
        made_of, solid = self._solids.get(member.item.object_id, (None, None))
        if made_of is not member or solid is None:
            solid = member.solid
            self._solids[member.item.object_id] = member, solid
        return solid

    def _loose(self) -> list[CompositeMember]:
        return [member for name, member in self.members.items() if name != self._root]

    def _gone(self) -> list[str]:
        """List contents that do not lie in their container."""
        loose = self._loose()
        holders = {name: self.holder(name) for name in sorted({member.container_id for member in loose})}
        return [m.item.object_id for m in loose if not holders[m.container_id].holds(m.mesh)]

    def _remove(self, name: str) -> None:
        """Take an object out, with all that it contains."""
        if self.members.pop(name, None) is not None:
            for inner in [m.item.object_id for m in self._loose() if m.container_id == name]:
                self._remove(inner)

    def _fell_in(self, start: CompositeMember, holder: HollowVessel, slippery: bool = False) -> bool:
        if not self._budget.may_drop:
            return False
        inside = list(self.members.values())
        rest = self._fallen(inside, [start], slippery)
        self._budget.dropping_s -= rest.time_s
        if rest.warnings or not rest.at_rest:
            return False
        ended = start.at(rest.poses[0])
        if not holder.holds(ended.mesh) or not self._is_carried(ended, inside):
            return False
        self.members[start.item.object_id] = ended
        return True

    def _is_carried(self, member: CompositeMember, others: Sequence[CompositeMember]) -> bool:
        """Whether its mesh touches another: pieces that close a vessel would carry contents over the void."""
        solid, mesh = member.solid, member.mesh
        reach = self._gap_m([member, *others]) + SLACK_M
        return any(meshes_touch(solid, mesh, self._solid(other), other.mesh, reach) for other in others)

    def _gap_m(self, members: Sequence[CompositeMember]) -> float:
        """The gap between pieces that free fall keeps [m]."""
        uncovered = max(member.item.scale * member.pieces.uncovered_m for member in members)
        return self._rectify.clearance_m + 2 * uncovered + SLACK_M

    def _fallen(self, fixed: list[CompositeMember], falling: list[CompositeMember], slippery: bool = False) -> Rest:
        return simulate_fall(
            [member.body for member in fixed],
            [member.body for member in falling],
            gap_m=self._gap_m([*fixed, *falling]),
            timestep_s=self._timestep_s,
            max_time_s=self._rectify.fall_time_s,
            slippery=slippery,
        )


def follow_container(member: CompositeMember, container: CompositeMember) -> CompositeMember:
    """Move a content along with its container, from where both were seen."""
    motion = compose_poses(container.pose, invert_pose(container.item.pose))
    return member.at(compose_poses(motion, member.item.pose))
