"""The MeshModel door: whatever turns one object of a picture into a closed mesh."""

from typing import Protocol

from schemas.objects import PerceivedObjects
from tableverse_factory.place.complete import complete_carved
from tableverse_factory.place.completion import Completion
from tableverse_factory.place.replay import recorded_mesh
from tableverse_factory.place.sighting import Sighting


class MeshModel(Protocol):
    """One object of a scene to its whole mesh."""

    def __call__(self, scene: PerceivedObjects, sighting: Sighting) -> Completion:
        """The completed mesh, with its pose where the model knows it; else registration finds pose and size.

        Raises:
            GeometryError: where this model has no mesh for the object, with what was found.
        """
        ...


MESH_MODELS: dict[str, MeshModel] = {"carved": complete_carved, "replay": recorded_mesh}
