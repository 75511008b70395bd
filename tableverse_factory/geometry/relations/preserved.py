"""Support and containment in a layout, and how much of them a result preserves."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass

from schemas.geometry import ConvexPieces, Pose
from schemas.objects import PlacedObject
from tableverse_factory.geometry.collision.solids import place_pieces
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.relations.relations import compute_body_features, is_inside
from tableverse_factory.geometry.relations.support import Pairs, find_mesh_support, find_piece_support


@dataclass(frozen=True, slots=True)
class Relations:
    """Relations in a layout, as pairs of object indices; the table is no object.

    Pairs (carried, carrier) touch on their meshes or pieces, with a normal that points up (`support`); in pairs
    (content, vessel) one reaches into the open room of the other (`relations`).
    """

    carried: Pairs
    carried_on_pieces: Pairs
    contained: Pairs

    def renumbered(self, index: Sequence[int]) -> "Relations":
        """Renumber object i to `index[i]` of a larger layout."""
        kinds = (self.carried, self.carried_on_pieces, self.contained)
        return Relations(*(frozenset((index[i], index[j]) for i, j in pairs) for pairs in kinds))

    def without(self, crossing: Pairs) -> "Relations":
        """Remove pairs, in either order."""
        kinds = (self.carried, self.carried_on_pieces, self.contained)
        return Relations(*(frozenset((i, j) for i, j in pairs if not {(i, j), (j, i)} & crossing) for pairs in kinds))


@dataclass(frozen=True, slots=True)
class PreservedRelations:
    """How many relations of the truth there are, and how many of them hold in a result; contents are not carried."""

    carried: int = 0
    carried_kept: int = 0
    contained: int = 0
    contained_kept: int = 0

    def __add__(self, other: "PreservedRelations") -> "PreservedRelations":
        return PreservedRelations(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))


def find_relations(
    objects: Sequence[PlacedObject], pieces: Sequence[ConvexPieces], poses: Sequence[Pose], scales: Sequence[float]
) -> Relations:
    """Find the relations between objects at these poses and scales in the table frame."""
    solids = [place_pieces(its, pose, scale) for its, pose, scale in zip(pieces, poses, scales, strict=True)]
    meshes = [place_mesh(placed.mesh, pose, scale) for placed, pose, scale in zip(objects, poses, scales, strict=True)]
    bodies = [compute_body_features(mesh) for mesh in meshes]
    contained = frozenset(
        (i, j) for i, x in enumerate(bodies) for j, y in enumerate(bodies) if i != j and is_inside(x, y)
    )
    return Relations(find_mesh_support(meshes), find_piece_support(solids), contained)


def compare_relations(truth: Relations, result: Relations) -> PreservedRelations:
    """Compare a result with the truth; what lies in a vessel counts as contained, not as carried by it as well.

    The truth is read on the meshes. In a result contacts of the pieces count too: they are what a simulation feels.
    """
    on = truth.carried - truth.contained
    still_on = on & (result.carried | result.carried_on_pieces)
    return PreservedRelations(len(on), len(still_on), len(truth.contained), len(truth.contained & result.contained))
