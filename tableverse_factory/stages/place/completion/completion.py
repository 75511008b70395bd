"""The answer of a MeshModel."""

from dataclasses import dataclass

from schemas.geometry import Frozen, Pose, TriangleMesh


@dataclass(frozen=True, slots=True, eq=False)
class Completion(Frozen):
    """A closed mesh and, where the model knows it, its pose.

    Attributes:
        mesh: In its own frame, metric where `pose` is given.
        pose: Its own frame in the table frame; None where registration has to find pose and size.
        method: Who made it and how, e.g. `carved/box`.
        licence: Of the mesh, where a model made it and says so.
    """

    mesh: TriangleMesh
    pose: Pose | None
    method: str
    licence: str | None = None
