"""The mesh model `replay`: meshes recorded beside the capture."""

import numpy as np

from schemas.objects import PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.stages.place.interfaces import Completion
from tableverse_factory.stages.place.view.object_view import ObjectView


def replay_mesh(scene: PerceivedObjects, view: ObjectView) -> Completion:
    """Return the recorded mesh of the instance with most of the object's pixels; registration finds its pose.

    Raises:
        GeometryError: if nothing was recorded for it.
    """
    meshes = dict(scene.observation.recorded_meshes)
    ids = scene.observation.recorded_ids
    if not meshes or ids is None:
        raise GeometryError("the capture has no recorded meshes: put meshes/<instance id>.obj beside its masks.png")
    values, counts = np.unique(ids[scene.instance_ids == view.instance_id], return_counts=True)
    instance_id = int(values[np.argmax(counts)]) if len(values) else 0
    if instance_id not in meshes:
        raise GeometryError(f"no mesh recorded for instance {instance_id}; there are {sorted(meshes)[:10]}")
    return Completion(meshes[instance_id], None, "replay")
