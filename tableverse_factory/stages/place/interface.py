"""The MeshModel door: whatever turns the objects of a picture into closed meshes."""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from schemas.config import PlaceConfig
from schemas.objects import PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.completion.completion import Completion
from tableverse_factory.stages.place.completion.select_shape import complete_by_carving
from tableverse_factory.stages.place.mesh_service.model_completion import complete_with_model
from tableverse_factory.stages.place.replay import replay_mesh
from tableverse_factory.stages.place.view.object_view import ObjectView


class MeshModel(Protocol):
    """All objects of a scene to their whole meshes, at once: a model on a GPU wants them together."""

    def __call__(
        self,
        scene: PerceivedObjects,
        sightings: Sequence[ObjectView],
        config: PlaceConfig,
        rng: np.random.Generator,
        services: Services,
    ) -> Sequence[Completion | GeometryError]:
        """For each object its mesh, with its pose where the model knows it (else registration finds pose and size).

        An object that has none gets the error that says why.

        Raises:
            ModelError: where the model is out of reach for all of them.
        """
        ...


def complete_one_by_one(complete: Callable[[PerceivedObjects, ObjectView], Completion]) -> MeshModel:
    """The door of what completes one object of a scene at a time, and raises GeometryError where it cannot."""

    def each(
        scene: PerceivedObjects,
        sightings: Sequence[ObjectView],
        config: PlaceConfig,  # noqa: ARG001
        rng: np.random.Generator,  # noqa: ARG001
        services: Services,  # noqa: ARG001
    ) -> list[Completion | GeometryError]:
        answers: list[Completion | GeometryError] = []
        for sighting in sightings:
            try:
                answers.append(complete(scene, sighting))
            except GeometryError as error:
                answers.append(error)
        return answers

    return each


MESH_MODELS: dict[str, MeshModel] = {
    "carved": complete_one_by_one(complete_by_carving),
    "replay": complete_one_by_one(replay_mesh),
    "sam3d": complete_with_model,
    "triposr": complete_with_model,
}
