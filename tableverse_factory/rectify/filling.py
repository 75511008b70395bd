"""One composite in the making: a container that stands still, and what has been dropped into it so far."""

from collections.abc import Sequence

import numpy as np

from schemas.config import Config
from tableverse_factory.geometry.holding import Holder, holder_of
from tableverse_factory.geometry.touching import seen_to_touch
from tableverse_factory.geometry.transforms import compose, inverse
from tableverse_factory.physics.freefall import fall
from tableverse_factory.rectify.pouring import Member, random_start, seen_starts

SEEN_TRIES, RANDOM_TRIES = 8, 3
"""Falls from starts near where a thing was seen, and from random ones."""
SLACK_M = 1e-4
"""Gap that free fall keeps beyond the clearance: contacts give way by a fifth of this."""
MAX_SIMULATED_S = 60.0
"""Simulated time for one composite [s]: bounds a container that nothing fits into."""


class Filling:
    """A container and its contents, in the order in which they went in.

    Args:
        root: The outermost container; stands still.
        config: Of the run.
        rng: Of the stage; used for random starts alone.
    """

    def __init__(self, root: Member, config: Config, rng: np.random.Generator) -> None:
        self.members: dict[str, Member] = {root.item.object_id: root}
        self._root = root.item.object_id
        self._rectify, self._timestep_s = config.rectify, config.settle.timestep_s
        self._rng = rng
        self._simulated_s = 0.0

    def holder(self, container_id: str) -> Holder:
        """The container where it is now."""
        return holder_of(self.members[container_id].mesh)

    def put(self, member: Member, holder: Holder) -> bool:
        """Lets a thing fall into the container from near its pose; whether it came to lie inside."""
        solids = [other.solid for other in self.members.values()]
        starts = seen_starts(member, solids, holder, self._rectify.clearance_m)
        tries = zip(range(SEEN_TRIES), starts, strict=False)
        return any(self._fell_in(start, holder) for _, start in tries) or self.pour(member, holder)

    def pour(self, member: Member, holder: Holder) -> bool:
        """Lets a thing fall into the container from a random start; whether it came to lie inside."""
        solids = [other.solid for other in self.members.values()]
        clearance = self._rectify.clearance_m
        starts = (random_start(member, solids, holder, clearance, self._rng) for _ in range(RANDOM_TRIES))
        return any(self._fell_in(start, holder, slippery=True) for start in starts)

    def relax(self) -> tuple[str, ...]:
        """Frees all contents together until they rest; names those that left their container, and takes them out."""
        lost: list[str] = []
        while (loose := self._loose()) and (lost or len(loose) > 1):  # a single thing has come to rest already
            ended = self._fallen([self.members[self._root]], loose)
            self.members.update((member.item.object_id, member) for member in ended or ())
            gone = self._gone() if ended else []
            if not gone:
                break
            for name in gone:
                self._remove(name)
            lost += gone
        return tuple(lost)

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

    def _fell_in(self, start: Member, holder: Holder, slippery: bool = False) -> bool:
        if self._simulated_s > MAX_SIMULATED_S:
            return False
        inside = list(self.members.values())
        ended = self._fallen(inside, [start], slippery)
        if ended is None or not holder.holds(ended[0].mesh) or not self._is_carried(ended[0], inside):
            return False
        self.members[start.item.object_id] = ended[0]
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

    def _fallen(self, fixed: list[Member], falling: list[Member], slippery: bool = False) -> list[Member] | None:
        """The falling things where they ended; None where the simulation broke."""
        rest = fall(
            [member.body for member in fixed],
            [member.body for member in falling],
            gap_m=self._gap_m([*fixed, *falling]),
            timestep_s=self._timestep_s,
            max_time_s=self._rectify.fall_time_s,
            slippery=slippery,
        )
        self._simulated_s += rest.time_s
        if rest.warnings:
            return None
        return [member.at(pose) for member, pose in zip(falling, rest.poses, strict=True)]


def carried_along(member: Member, container: Member) -> Member:
    """A content where it was seen relative to its container, which may have moved since."""
    motion = compose(container.pose, inverse(container.item.pose))
    return member.at(compose(motion, member.item.pose))
