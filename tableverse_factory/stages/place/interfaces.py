"""Interface of the models that complete the objects of a picture to closed meshes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from schemas.config import PlaceConfig
from schemas.geometry import Frozen, Pose, TriangleMesh
from schemas.objects import PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.view.object_view import ObjectView


@dataclass(frozen=True, slots=True, eq=False)
class Completion(Frozen):
    """A closed mesh in its own frame.

    Attributes:
        pose: Its frame in the table frame, with a mesh in metres; None where registration has to find pose and size.
        method: Backend and method, e.g. `carved/box`.
        licence: Licence of the mesh, where a model made it and names one.
    """

    mesh: TriangleMesh
    pose: Pose | None
    method: str
    licence: str | None = None


# Completes all objects of a scene at once, as a model on a GPU needs them together; an error says why one has no mesh.
# It raises ModelError if it is out of reach for all of them.
MeshModel = Callable[
    [PerceivedObjects, Sequence[ObjectView], PlaceConfig, np.random.Generator, Services],
    Sequence[Completion | GeometryError],
]
