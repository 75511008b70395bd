"""Composite assembly (paper section 3.1): what containers hold is dropped into them, one by one, in isolation.

What was seen starts where it was seen, as far as that is free; what was only counted repeats the mesh of its
representative and starts at random. While one thing falls all others stand still, so that nothing that was seen is
pushed about by what is only filled in; when all are in, they are freed together and find their common rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.config import Config
from schemas.geometry import ConvexPieces, Pose
from schemas.identity import content_hash
from schemas.objects import Evidence, PlacedObject, PlacedObjects
from tableverse_factory.errors import GeometryError
from tableverse_factory.geometry.meshes import placed_mesh
from tableverse_factory.physics.prior import prior_body
from tableverse_factory.rectify.filling import Filling, carried_along
from tableverse_factory.rectify.pouring import Member

MAX_ID_CHARS = 96


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
        self._objects = {o.object_id: replace(o, count=1) for o in objects}
        self._counts = {o.object_id: o.count for o in objects}
        self._pieces = dict(zip(self._objects, pieces, strict=True))
        self._config, self._rng = config, rng
        self._poses = {o.object_id: o.pose for o in objects}
        self._left_out: dict[str, str] = {}
        self._copies: dict[str, list[PlacedObject]] = {}
        self._taken = {o.object_id.lower() for o in objects}
        contents = [o.object_id for o in objects if o.contained_in is not None]
        limit = config.rectify.max_contents
        self._refused = set(sorted(contents)[limit:])
        self._copies_left = max(limit - len(contents), 0)

    def fill(self, root: str) -> None:
        """Assembles the composite around its outermost container; nothing happens to an object that holds nothing."""
        if not self._contents(root):
            self._miscount(root)
            return
        try:
            filling = Filling(self._member(self._objects[root]), self._config, self._rng)
        except GeometryError as error:
            self._leave_contents(root, f"its container cannot be simulated: {error}")
            return
        waiting = [root]
        while waiting:
            container = waiting.pop(0)
            inside = self._put_contents(filling, container)
            self._pour_copies(filling, container, inside)
            waiting += [name for name in inside if self._contents(name)]
        for name in filling.relax():
            self._leave(name, "left its container when all contents were freed together")
        self._poses.update((name, member.pose) for name, member in filling.members.items())
