"""One composite in the making: a container that stands still, and what has been dropped into it so far."""

from collections.abc import Sequence

import numpy as np

from schemas.config import Config
from tableverse_factory.geometry.collision.contacts import seen_to_touch
from tableverse_factory.geometry.math.transforms import compose, inverse
from tableverse_factory.geometry.relations.containers import HollowVessel, holder_of
from tableverse_factory.physics.simulate.at_rest import Rest
from tableverse_factory.physics.simulate.freefall import fall
from tableverse_factory.stages.rectify.budget import OUT_OF_BUDGET, SimulationBudget
from tableverse_factory.stages.rectify.drop_contents import Member, Surroundings, random_start, seen_starts

SEEN_TRIES, RANDOM_TRIES = 8, 3
"""Falls from starts near where a thing was seen, and from random ones."""
SLACK_M = 1e-4
"""Gap that free fall keeps beyond the clearance: contacts give way by a fifth of this."""
FREED_TRIES = 2
"""How often all contents may be freed together: what rolled when the time was up starts from standstill again."""
LEFT = "left its container when everything in it was freed together"
RESTLESS = "did not come to rest when everything in its container was freed together"
UNSTABLE = "the simulation broke down when everything in its container was freed together"


class Filling:
    """A container and its contents, in the order in which they went in.

    Args:
        root: The outermost container; stands still.
        config: Of the run.
        rng: Of the stage; used for random starts alone.
        budget: Of the scene.
    """

    def __init__(self, root: Member, config: Config, rng: np.random.Generator, budget: SimulationBudget) -> None:
        self.members: dict[str, Member] = {root.item.object_id: root}
        self._root = root.item.object_id
        self._rectify, self._timestep_s = config.rectify, config.settle.timestep_s
        self._rng = rng
        self._budget = budget

    def holder(self, container_id: str) -> HollowVessel:
        """The container where it is now."""
        return holder_of(self.members[container_id].mesh)

    def put(self, member: Member, holder: HollowVessel) -> bool:
        """Lets a thing fall into the container from near its pose; whether it came to lie inside."""
        starts = seen_starts(member, self._surroundings(), holder)
        tries = zip(range(SEEN_TRIES), starts, strict=False)
        return any(self._fell_in(start, holder) for _, start in tries) or self.pour(member, holder)

    def pour(self, member: Member, holder: HollowVessel) -> bool:
        """Lets a thing fall into the container from a random start; whether it came to lie inside."""
        around = self._surroundings()
        tries = (_ for _ in range(RANDOM_TRIES) if self._budget.may_drop)
        starts = (random_start(member, around, holder, self._rng) for _ in tries)
        return any(self._fell_in(start, holder, slippery=True) for start in starts)

    def relax(self) -> dict[str, str]:
        """Frees all contents together until they rest in their containers.

        Returns:
            What had to be taken out for that, and why.
        """
        lost: dict[str, str] = {}
        while (loose := self._loose()) and (lost or len(loose) > 1):  # a single thing has come to rest already
            out = self._freed(loose)
            if not out:
                break
            for name in out:
                self._remove(name)
            lost |= out
        return lost

    def _freed(self, loose: list[Member]) -> dict[str, str]:
        """Frees contents together; what has to be taken out: nothing where all come to rest in their containers."""
        for _ in range(FREED_TRIES):
            if not self._budget.may_free:
                return {member.item.object_id: OUT_OF_BUDGET for member in loose}
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
        solids = [member.solid for member in self.members.values()]
        return Surroundings(solids, self._rectify.clearance_m, self._budget)

    def _loose(self) -> list[Member]:
        return [member for name, member in self.members.items() if name != self._root]

    def _gone(self) -> list[str]:
        """Contents that do not lie in their container."""
        loose = self._loose()
        holders = {name: self.holder(name) for name in sorted({member.container_id for member in loose})}
        return [m.item.object_id for m in loose if not holders[m.container_id].holds(m.mesh)]

    def _remove(self, name: str) -> None:
        """Takes a thing out, and all that it contains."""
        if self.members.pop(name, None) is not None:
            for inner in [m.item.object_id for m in self._loose() if m.container_id == name]:
                self._remove(inner)

    def _fell_in(self, start: Member, holder: HollowVessel, slippery: bool = False) -> bool:
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

    def _is_carried(self, member: Member, others: Sequence[Member]) -> bool:
        """Whether one sees what it rests on: pieces that close a vessel would carry things over the void."""
        solid, mesh = member.solid, member.mesh
        reach = self._gap_m([member, *others]) + SLACK_M
        return any(seen_to_touch(solid, mesh, other.solid, other.mesh, reach) for other in others)

    def _gap_m(self, members: Sequence[Member]) -> float:
        """The gap between pieces at which free fall leaves these things [m]."""
        uncovered = max(member.item.scale * member.pieces.uncovered_m for member in members)
        return self._rectify.clearance_m + 2 * uncovered + SLACK_M

    def _fallen(self, fixed: list[Member], falling: list[Member], slippery: bool = False) -> Rest:
        return fall(
            [member.body for member in fixed],
            [member.body for member in falling],
            gap_m=self._gap_m([*fixed, *falling]),
            timestep_s=self._timestep_s,
            max_time_s=self._rectify.fall_time_s,
            slippery=slippery,
        )


def carried_along(member: Member, container: Member) -> Member:
    """A content where it was seen relative to its container, which may have moved since."""
    motion = compose(container.pose, inverse(container.item.pose))
    return member.at(compose(motion, member.item.pose))
