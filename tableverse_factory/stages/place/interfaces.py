"""Protocol of the models that complete the objects of a picture to closed meshes, and their answer."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from schemas.config import PlaceConfig
from schemas.geometry import Frozen, Pose, TriangleMesh
from schemas.objects import PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.view.object_view import ObjectView


@dataclass(frozen=True, slots=True, eq=False)
class Completion(Frozen):
    """A closed mesh and, where the model knows it, its pose.

    Attributes:
        mesh: Mesh in its own frame, metric where `pose` is given.
        pose: Its own frame in the table frame; None where registration has to find pose and size.
        method: Backend and method, e.g. `carved/box`.
        licence: Licence of the mesh, where a model made it and names one.
    """

    mesh: TriangleMesh
    pose: Pose | None
    method: str
    licence: str | None = None


class MeshModel(Protocol):
    """Completes all objects of a scene at once: a model on a GPU needs them together."""

    def __call__(
        self,
        scene: PerceivedObjects,
        views: Sequence[ObjectView],
        config: PlaceConfig,
        rng: np.random.Generator,
        services: Services,
    ) -> Sequence[Completion | GeometryError]:
        """Complete each object, or return the error that says why it has no mesh.

        Raises:
            ModelError: if the model is out of reach for all of them.
        """
        ...
