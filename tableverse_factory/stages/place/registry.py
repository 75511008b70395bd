"""Table of mesh models by the name in `place.mesh_model`."""

from collections.abc import Callable, Sequence

import numpy as np

from schemas.config import PlaceConfig
from schemas.objects import PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.completion.select_shape import complete_by_carving
from tableverse_factory.stages.place.interfaces import Completion, MeshModel
from tableverse_factory.stages.place.mesh_service.model_completion import complete_with_model
from tableverse_factory.stages.place.replay import replay_mesh
from tableverse_factory.stages.place.view.object_view import ObjectView


def complete_one_by_one(complete: Callable[[PerceivedObjects, ObjectView], Completion]) -> MeshModel:
    """Adapt a function that completes one object at a time, and raises GeometryError where it cannot."""

    def complete_each(
        scene: PerceivedObjects,
        views: Sequence[ObjectView],
        config: PlaceConfig,  # noqa: ARG001
        rng: np.random.Generator,  # noqa: ARG001
        services: Services,  # noqa: ARG001
    ) -> list[Completion | GeometryError]:
        answers: list[Completion | GeometryError] = []
        for view in views:
            try:
                answers.append(complete(scene, view))
            except GeometryError as error:
                answers.append(error)
        return answers

    return complete_each


MESH_MODELS: dict[str, MeshModel] = {
    "carved": complete_one_by_one(complete_by_carving),
    "replay": complete_one_by_one(replay_mesh),
    "sam3d": complete_with_model,
    "triposr": complete_with_model,
}
