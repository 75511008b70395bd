"""Table of mesh models by the name in `place.mesh_model`."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from schemas.objects import PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.stages.place.completion.overlap import remove_overlaps
from tableverse_factory.stages.place.completion.select_shape import complete_by_carving
from tableverse_factory.stages.place.interfaces import Completion, MeshModel
from tableverse_factory.stages.place.mesh_service.model_completion import complete_with_model
from tableverse_factory.stages.place.view.object_view import ObjectView


def replay_mesh(scene: PerceivedObjects, view: ObjectView) -> Completion:
    """Return the mesh recorded for the instance with most of the object's pixels; registration finds its pose."""
    meshes = dict(scene.observation.recorded_meshes)
    ids = scene.observation.recorded_ids
    if not meshes or ids is None:
        raise GeometryError("the capture has no recorded meshes: put meshes/<instance id>.obj beside its masks.png")
    values, counts = np.unique(ids[scene.instance_ids == view.instance_id], return_counts=True)
    instance_id = int(values[np.argmax(counts)]) if len(values) else 0
    if instance_id not in meshes:
        raise GeometryError(f"no mesh recorded for instance {instance_id}; there are {sorted(meshes)[:10]}")
    return Completion(meshes[instance_id], None, "replay")


def complete_one_by_one(
    complete: Callable[[PerceivedObjects, ObjectView], Completion],
    scene: PerceivedObjects,
    views: Sequence[ObjectView],
    *_: object,
) -> list[Completion | GeometryError]:
    """Complete the objects of a scene by a function for one object, which raises GeometryError where it cannot."""
    answers: list[Completion | GeometryError] = []
    for view in views:
        try:
            answers.append(complete(scene, view))
        except GeometryError as error:
            answers.append(error)
    return answers


def complete_scene_by_carving(
    scene: PerceivedObjects, views: Sequence[ObjectView], *_: object
) -> list[Completion | GeometryError]:
    """Complete the objects of a scene one by one, then remove the overlaps of what nobody saw."""
    return remove_overlaps(scene, views, complete_one_by_one(complete_by_carving, scene, views))


MESH_MODELS: dict[str, MeshModel] = {
    "carved": complete_scene_by_carving,
    "replay": partial(complete_one_by_one, replay_mesh),
    "sam3d": complete_with_model,
    "triposr": complete_with_model,
}
