"""Composite assembly (paper section 3.1): what containers hold is dropped into them, one by one, in isolation.

What was seen starts where it was seen, as far as that is free; what was only counted repeats the mesh of its
representative and starts at random. While one thing falls all others stand still, so that nothing that was seen is
pushed about by what is only filled in; when all are in, they are freed together and find their common rest.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.config import Config
from schemas.geometry import ConvexPieces, Pose
from schemas.identity import MAX_STEM_CHARS, colliding_names, content_hash
from schemas.objects import Evidence, PlacedObject, PlacedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.aabb import size_around
from tableverse_factory.geometry.mesh.meshes import placed_mesh
from tableverse_factory.geometry.relations.containers import HollowVessel
from tableverse_factory.physics.bodies.prior_mass import prior_body
from tableverse_factory.stages.rectify.budget import OUT_OF_BUDGET, SimulationBudget
from tableverse_factory.stages.rectify.drop_contents import Member
from tableverse_factory.stages.rectify.fill_container import Filling, carried_along


@dataclass(frozen=True, slots=True, eq=False)
class Assembled:
    """A layout whose containers hold what they should.

    Attributes:
        placed: The objects, copies behind their representative, without those that do not fit.
        pieces: Of each object.
        poses: Of each object, in the table frame: as placed, but for contents.
    """

    placed: PlacedObjects
    pieces: tuple[ConvexPieces, ...]
    poses: tuple[Pose, ...]


def assemble(
    item: PlacedObjects, pieces: Sequence[ConvexPieces], config: Config, rng: np.random.Generator
) -> Assembled:
    """Drops the contents of every container into it, then theirs; each object is counted once from here on.

    The result depends on ids and geometry, not on the order of the objects.
    """
    objects = without_circles(item.objects)
    assembly = _Assembly(objects, pieces, config, rng)
    for root in sorted(o.object_id for o in objects if o.contained_in is None):
        assembly.fill(root)
    return assembly.result(item)


class _Assembly:
    """What is where so far, over all containers of a scene."""

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
        self._limit = config.rectify.max_contents
        seen = sorted(o.object_id for o in objects if o.contained_in is not None)
        self._beyond = frozenset(seen[self._limit :])
        self._room_for_copies = max(self._limit - len(seen), 0)

    def fill(self, root: str) -> None:
        """Assembles the composite around its outermost container, level by level."""
        if not self._contents(root):
            return
        try:
            filling = Filling(self._member(root), self._config, self._rng, self._budget)
        except GeometryError as error:
            self._leave_contents(root, f"its container cannot be simulated: {error}")
            return
        waiting = [root]
        while waiting:
            container = waiting.pop(0)
            holder = filling.holder(container)
            inside = [name for name in self._contents(container) if self._put(filling, name, holder)]
            for name in inside:
                self._repeat(filling, name, holder)
            waiting += inside
        for name, reason in filling.relax().items():
            self._leave(name, reason)
        self._poses.update((name, member.pose) for name, member in filling.members.items())

    def result(self, item: PlacedObjects) -> Assembled:
        """The layout as it is now, in the order of `item`."""
        for name, uncounted in self._uncounted.items():
            if uncounted and name in self._poses and self._objects[name].contained_in is None:
                self._miss(name, 2, uncounted + 1, "no container says where they are")
        copies: dict[str, list[str]] = {o.object_id: [] for o in item.objects}
        for name, thing in self._objects.items():
            if thing.copy_of is not None:
                copies[thing.copy_of].append(name)
        order = [name for o in item.objects for name in (o.object_id, *copies[o.object_id]) if name in self._poses]
        objects = tuple(self._objects[name] for name in order)
        evidence = None if item.evidence is None else _repeated(item.evidence, item.objects, objects)
        placed = replace(item, objects=objects, evidence=evidence, left_out=(*item.left_out, *self._left_out.items()))
        return Assembled(
            placed, tuple(map(self._pieces.__getitem__, order)), tuple(map(self._poses.__getitem__, order))
        )

    def _put(self, filling: Filling, name: str, holder: HollowVessel) -> bool:
        """Drops what was seen; whether it is in."""
        container = self._objects[name].contained_in or ""
        try:
            member = carried_along(self._member(name), filling.members[container])
        except GeometryError as error:
            self._leave(name, str(error))
            return False
        if name in self._beyond:
            self._leave(name, f"there are more than {self._limit} things in containers")
        elif filling.put(member, holder):
            return True
        elif not self._budget.may_drop:
            self._leave(name, OUT_OF_BUDGET)
        else:
            self._leave(name, f"does not fit into {container}: wherever it was dropped, it came to rest outside")
        return False

    def _repeat(self, filling: Filling, name: str, holder: HollowVessel) -> None:
        """Pours in the copies of a content, as many as were counted, until one does not fit."""
        last = self._uncounted[name] + 1
        original = filling.members[name]
        container = original.item.contained_in or ""
        for number in range(2, last + 1):
            if self._room_for_copies == 0:
                self._miss(name, number, last, f"there are more than {self._limit} things in containers")
                return
            copy_id = _copy_id(name, number, self._objects)
            thing = replace(self._objects[name], object_id=copy_id, copy_of=name)
            body = replace(original.body, object_id=copy_id)
            if not filling.pour(replace(original, item=thing, body=body), holder):
                reason = f"no room in {container}" if self._budget.may_drop else OUT_OF_BUDGET
                self._miss(name, number, last, reason)
                return
            self._objects[copy_id], self._pieces[copy_id] = thing, self._pieces[name]
            self._room_for_copies -= 1

    def _member(self, name: str) -> Member:
        thing, pieces = self._objects[name], self._pieces[name]
        return Member(thing, pieces, prior_body(thing, pieces, thing.pose))

    def _contents(self, container: str) -> list[str]:
        """What was seen in a container, the lowest first: the others may lie on it."""
        inside = [o for o in self._objects.values() if o.contained_in == container and o.copy_of is None]
        return [o.object_id for o in sorted(inside, key=lambda o: (_lowest(o), o.object_id))]

    def _leave(self, name: str, reason: str) -> None:
        """Leaves an object out, and with it all that it holds."""
        self._poses.pop(name, None)
        self._left_out[name] = reason
        self._leave_contents(name, f"its container {name} is left out")

    def _leave_contents(self, container: str, reason: str) -> None:
        for name in [o.object_id for o in self._objects.values() if o.contained_in == container]:
            self._leave(name, reason)

    def _miss(self, name: str, first: int, last: int, reason: str) -> None:
        """Records copies that are not there, under the id that the first of them would have."""
        which = f"number {last}" if first == last else f"numbers {first} to {last}"
        self._left_out[_copy_id(name, first, self._objects)] = f"{which} of {name}: {reason}"


def without_circles(objects: Sequence[PlacedObject]) -> tuple[PlacedObject, ...]:
    """The objects, each with a container that stands on the table in the end.

    A container that is not there is forgotten. Where containers hold one another in a circle, the largest of them is
    the outermost.
    """
    holder = {o.object_id: o.contained_in for o in objects}
    size = {o.object_id: (_volume(o), o.object_id) for o in objects}
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


def _copy_id(name: str, number: int, taken: Collection[str]) -> str:
    """`obj_003_2` for the second `obj_003`; a hash where that is too long or clashes with another object."""
    plain = f"{name}_{number}"
    if len(plain) <= MAX_STEM_CHARS and plain not in colliding_names([*taken, plain]):
        return plain
    return f"copy-{content_hash(plain.encode())[:16]}"


def _repeated(evidence: Evidence, before: Sequence[PlacedObject], after: Sequence[PlacedObject]) -> Evidence:
    """The evidence for other objects: a copy has the pixels of what it repeats."""
    pixels = {o.object_id: value for o, value in zip(before, evidence.object_pixels, strict=True)}
    return replace(evidence, object_pixels=tuple(pixels[o.copy_of or o.object_id] for o in after))


def _lowest(item: PlacedObject) -> float:
    return float(placed_mesh(item.mesh, item.pose, item.scale).vertices[:, 2].min())


def _volume(item: PlacedObject) -> float:
    return float(np.prod(size_around(item.mesh.vertices)) * item.scale**3)
