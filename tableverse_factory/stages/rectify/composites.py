"""Composite assembly (paper section 3.1): contents are dropped into their containers, one by one, in isolation.

Seen contents start where they were seen, counted ones at random with the mesh of their representative. While one falls
all others stand still, so that copies do not displace seen contents; in the end all are settled together.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.config import Config
from schemas.geometry import ConvexPieces, Pose
from schemas.identity import MAX_STEM_CHARS, content_hash, find_name_clashes
from schemas.objects import PlacedObject, PlacedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.aabb import aabb_size
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.relations.containers import HollowVessel
from tableverse_factory.physics.bodies.prior_mass import make_prior_body
from tableverse_factory.stages.rectify.drop_contents import BUDGET_SPENT, CompositeMember, SimulationBudget
from tableverse_factory.stages.rectify.fill_container import ContainerFilling, follow_container


@dataclass(frozen=True, slots=True, eq=False)
class AssembledLayout:
    """Objects with filled containers: copies follow their original, those that do not fit are left out.

    Each has its pieces and its pose in the table frame; only contents have moved.
    """

    placed: PlacedObjects
    pieces: tuple[ConvexPieces, ...]
    poses: tuple[Pose, ...]


def assemble_composites(
    item: PlacedObjects, pieces: Sequence[ConvexPieces], config: Config, rng: np.random.Generator
) -> AssembledLayout:
    """Drop the contents of every container into it, then theirs; from here on each object has count 1.

    The result depends on ids and geometry, not on the order of the objects.
    """
    objects = break_containment_cycles(item.objects)
    assembly = _Assembly(objects, pieces, config, rng)
    for root in sorted(o.object_id for o in objects if o.contained_in is None):
        assembly.fill(root)
    return assembly.result(item)


class _Assembly:
    def __init__(
        self, objects: Sequence[PlacedObject], pieces: Sequence[ConvexPieces], config: Config, rng: np.random.Generator
    ) -> None:
        self._objects = {o.object_id: o if o.count == 1 else replace(o, count=1) for o in objects}
        self._pieces = {o.object_id: its for o, its in zip(objects, pieces, strict=True)}
        self._poses = {o.object_id: o.pose for o in objects}
        self._uncounted = {o.object_id: o.count - 1 for o in objects}
        self._left_out: dict[str, str] = {}
        self._config, self._rng = config, rng
        self._budget = SimulationBudget()
        limit = config.rectify.max_contents
        seen = sorted(o.object_id for o in objects if o.contained_in is not None)
        self._beyond = frozenset(seen[limit:])
        self._room_for_copies = max(limit - len(seen), 0)
        self._too_many = f"there are more than {limit} things in containers"

    def fill(self, root: str) -> None:
        """Assemble the composite around its outermost container, level by level."""
        if not self._contents(root):
            return
        try:
            filling = ContainerFilling(self._member(root), self._config, self._rng, self._budget)
        except GeometryError as error:
            self._leave_contents(root, f"its container cannot be simulated: {error}")
            return
        waiting = [root]
        while waiting:
            container = waiting.pop(0)
            if not (contents := self._contents(container)):
                continue
            holder = filling.holder(container)
            inside = [name for name in contents if self._put(filling, name, holder)]
            for name in inside:
                self._repeat(filling, name, holder)
            waiting += inside
        for name, reason in filling.relax().items():
            self._leave(name, reason)
        self._poses.update((name, member.pose) for name, member in filling.members.items())

    def result(self, item: PlacedObjects) -> AssembledLayout:
        """List the objects in the order of `item`, and the copies that no container takes as left out."""
        for name, uncounted in self._uncounted.items():
            if uncounted and name in self._poses and self._objects[name].contained_in is None:
                self._miss(name, 2, uncounted + 1, "no container says where they are")
        copies: dict[str, list[str]] = {o.object_id: [] for o in item.objects}
        for name, thing in self._objects.items():
            if thing.copy_of is not None:
                copies[thing.copy_of].append(name)
        order = [name for o in item.objects for name in (o.object_id, *copies[o.object_id]) if name in self._poses]
        objects = tuple(self._objects[name] for name in order)
        evidence = item.evidence
        if evidence is not None:  # copies have the pixels of their original
            pixels = {o.object_id: value for o, value in zip(item.objects, evidence.object_pixels, strict=True)}
            evidence = replace(evidence, object_pixels=tuple(pixels[o.copy_of or o.object_id] for o in objects))
        placed = replace(item, objects=objects, evidence=evidence, left_out=(*item.left_out, *self._left_out.items()))
        pieces, poses = tuple(self._pieces[name] for name in order), tuple(self._poses[name] for name in order)
        return AssembledLayout(placed, pieces, poses)

    def _put(self, filling: ContainerFilling, name: str, holder: HollowVessel) -> bool:
        """Drop a seen content; returns whether it is in."""
        container = self._objects[name].contained_in or ""
        try:
            member = follow_container(self._member(name), filling.members[container])
        except GeometryError as error:
            self._leave(name, str(error))
            return False
        if name in self._beyond:
            self._leave(name, self._too_many)
        elif filling.put(member, holder):
            return True
        elif not self._budget.may_drop:
            self._leave(name, BUDGET_SPENT)
        else:
            self._leave(name, f"does not fit into {container}: wherever it was dropped, it came to rest outside")
        return False

    def _repeat(self, filling: ContainerFilling, name: str, holder: HollowVessel) -> None:
        """Drop the copies of a content, as many as were counted, until one does not fit."""
        last = self._uncounted[name] + 1
        original = filling.members[name]
        container = original.item.contained_in or ""
        for number in range(2, last + 1):
            if self._room_for_copies == 0:
                self._miss(name, number, last, self._too_many)
                return
            copy_id = _make_copy_id(name, number, self._objects)
            thing = replace(self._objects[name], object_id=copy_id, copy_of=name)
            body = replace(original.body, object_id=copy_id)
            if not filling.pour(replace(original, item=thing, body=body), holder):
                reason = f"no room in {container}" if self._budget.may_drop else BUDGET_SPENT
                self._miss(name, number, last, reason)
                return
            self._objects[copy_id], self._pieces[copy_id] = thing, self._pieces[name]
            self._room_for_copies -= 1

    def _member(self, name: str) -> CompositeMember:
        thing, pieces = self._objects[name], self._pieces[name]
        return CompositeMember(thing, pieces, make_prior_body(thing, pieces, thing.pose))

    def _contents(self, container: str) -> list[str]:
        """List the seen contents of a container, the lowest first: others may lie on them."""
        inside = [o for o in self._objects.values() if o.contained_in == container and o.copy_of is None]
        lowest = {o.object_id: place_mesh(o.mesh, o.pose, o.scale).vertices[:, 2].min() for o in inside}
        return sorted(lowest, key=lambda name: (lowest[name], name))

    def _leave(self, name: str, reason: str) -> None:
        """Leave an object out, with all that it contains."""
        self._poses.pop(name, None)
        self._left_out[name] = reason
        self._leave_contents(name, f"its container {name} is left out")

    def _leave_contents(self, container: str, reason: str) -> None:
        for name in [o.object_id for o in self._objects.values() if o.contained_in == container]:
            self._leave(name, reason)

    def _miss(self, name: str, first: int, last: int, reason: str) -> None:
        """Record missing copies under the id that the first of them would have."""
        which = f"number {last}" if first == last else f"numbers {first} to {last}"
        self._left_out[_make_copy_id(name, first, self._objects)] = f"{which} of {name}: {reason}"


def break_containment_cycles(objects: Sequence[PlacedObject]) -> tuple[PlacedObject, ...]:
    """Remove references to missing containers, and break containment cycles at the largest container."""
    holder = {o.object_id: o.contained_in for o in objects}
    size = {o.object_id: (np.prod(aabb_size(o.mesh.vertices)) * o.scale**3, o.object_id) for o in objects}
    for name in sorted(holder):
        chain: list[str] = []
        at: str | None = name
        while at in holder and at not in chain:
            chain.append(at)
            at = holder[at]
        if at in chain:
            holder[max(chain[chain.index(at) :], key=size.__getitem__)] = None
        elif at is not None:
            holder[chain[-1]] = None
    return tuple(
        o if o.contained_in == holder[o.object_id] else replace(o, contained_in=holder[o.object_id]) for o in objects
    )


def _make_copy_id(name: str, number: int, taken: Collection[str]) -> str:
    """Make `obj_003_2` for the second `obj_003`; a hash where that is too long or clashes with another object."""
    plain = f"{name}_{number}"
    if len(plain) <= MAX_STEM_CHARS and plain not in find_name_clashes([*taken, plain]):
        return plain
    return f"copy-{content_hash(plain.encode())[:16]}"
