"""The tiny pipeline with a stage that asks a mesh process for the object of a scene; the scene's name is its seed."""

import numpy as np

from schemas.geometry import Camera
from schemas.manifest import SceneKind
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.stage import Stage
from tableverse_factory.stages.place.mesh_service.client import MeshClient, MeshQuery, RgbdImage
from tests.helpers import tiny_pipeline


def mesh(item, config, rng, services):
    size = (4, 6)
    view = RgbdImage(np.zeros((*size, 3), np.uint8), np.ones(size, np.float32), Camera(5.0, 5.0, 3.0, 2.0, 6, 4))
    order = MeshQuery(np.ones(size, bool), int(item["name"]))
    (answer,) = MeshClient(config.place.mesh_command, config.place.mesh_timeout_s, services).make_meshes(view, [order])
    if isinstance(answer, str):
        raise GeometryError(answer)
    return tiny_pipeline.cut({**item, "name": "fine"}, config, rng, services)


_STAGES = tuple(
    Stage("mesh", "geometry", mesh, reads=("place",)) if stage.name == "cut" else stage
    for stage in tiny_pipeline._STAGES
)
PIPELINES = {SceneKind.CAPTURE: _STAGES}
