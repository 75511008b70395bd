"""Which of the relations that truly hold between things a result keeps: what carries what, and what holds what."""

from collections.abc import Sequence
from dataclasses import dataclass

from schemas.geometry import ConvexPieces, Pose
from schemas.objects import PlacedObject
from tableverse_factory.geometry.collision.solids import place_pieces
from tableverse_factory.geometry.mesh.meshes import placed_mesh
from tableverse_factory.geometry.relations.relations import body_of, is_inside
from tableverse_factory.geometry.relations.support import Pairs, carried_by_meshes, carried_by_pieces


@dataclass(frozen=True, slots=True)
class Relations:
    """What the geometry of a layout says; indices of objects, the table is none of them.

    Attributes:
        carried: Pairs (carried, carrier): their meshes touch, with a normal that points up (`geometry.support`).
        carried_on_pieces: The same of their convex pieces.
        contained: Pairs (content, vessel): one reaches into the open room of the other (`geometry.relations`).
    """

    carried: Pairs
    carried_on_pieces: Pairs
    contained: Pairs

    def renumbered(self, index: Sequence[int]) -> "Relations":
        """The same where object i is object `index[i]` of a larger layout."""
        kinds = (self.carried, self.carried_on_pieces, self.contained)
        return Relations(*(frozenset((index[i], index[j]) for i, j in pairs) for pairs in kinds))

    def without(self, crossing: Pairs) -> "Relations":
        """The same but for these pairs, in either order."""
        kinds = (self.carried, self.carried_on_pieces, self.contained)
        return Relations(*(frozenset((i, j) for i, j in pairs if not {(i, j), (j, i)} & crossing) for pairs in kinds))


@dataclass(frozen=True, slots=True)
class PreservedRelations:
    """How many relations of the truth there are, and how many of them hold in a result.

    Attributes:
        carried: True pairs (carried, carrier) that are no containment.
        carried_kept: Those of them in which the same object still carries the other.
        contained: True pairs (content, vessel).
        contained_kept: Those of them in which the content is still in the vessel.
    """

    carried: int = 0
    carried_kept: int = 0
    contained: int = 0
    contained_kept: int = 0

    def __add__(self, other: "PreservedRelations") -> "PreservedRelations":
        return PreservedRelations(
            self.carried + other.carried,
            self.carried_kept + other.carried_kept,
            self.contained + other.contained,
            self.contained_kept + other.contained_kept,
        )


def relations_of(
    objects: Sequence[PlacedObject], pieces: Sequence[ConvexPieces], poses: Sequence[Pose], scales: Sequence[float]
) -> Relations:
    """The relations between objects that stand at these poses and scales in the table frame."""
    solids = [place_pieces(its, pose, scale) for its, pose, scale in zip(pieces, poses, scales, strict=True)]
    meshes = [placed_mesh(placed.mesh, pose, scale) for placed, pose, scale in zip(objects, poses, scales, strict=True)]
    bodies = [body_of(mesh) for mesh in meshes]
    contained = frozenset(
        (i, j) for i, x in enumerate(bodies) for j, y in enumerate(bodies) if i != j and is_inside(x, y)
    )
    return Relations(carried_by_meshes(meshes), carried_by_pieces(solids), contained)


def compare_relations(truth: Relations, result: Relations) -> PreservedRelations:
    """Compares a result with the truth. What lies in a vessel counts as contained, not as carried by it as well.

    The truth is read on the meshes. In a result a contact of the pieces will do too: it is what a simulation feels.
    """
    on = truth.carried - truth.contained
    still_on = on & (result.carried | result.carried_on_pieces)
    return PreservedRelations(len(on), len(still_on), len(truth.contained), len(truth.contained & result.contained))
