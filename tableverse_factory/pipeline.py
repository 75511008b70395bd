"""THE LINE: which stages a row of the manifest runs through, in order. The only place where stages meet."""

import numpy as np

from schemas.config import Config
from schemas.manifest import SceneKind
from schemas.outcome import Outcome
from schemas.scene import ExportedScene
from tableverse_factory.models.services import Services
from tableverse_factory.stage import Pipelines, Stage
from tableverse_factory.stages.curate.curate import curate
from tableverse_factory.stages.export.export import export
from tableverse_factory.stages.observe.observe import observe, read_layout
from tableverse_factory.stages.perceive.perceive import perceive
from tableverse_factory.stages.place.place import place
from tableverse_factory.stages.rectify.rectify import rectify
from tableverse_factory.stages.settle import settle

_FROM_LAYOUT = (
    Stage("rectify", "geometry", rectify, reads=("rectify", "settle.timestep_s")),
    Stage("settle", "physics", settle, reads=("settle",)),
    Stage("curate", "curation", curate, reads=("curate",)),
    Stage("export", "physics", export, reads=("export", "settle")),
)

STAGES = (
    Stage("observe", "perception", observe, reads=("observe", "place.mesh_model", "models")),
    Stage("perceive", "perception", perceive, reads=("perceive", "models")),
    Stage("place", "geometry", place, reads=("place", "export.jpeg_quality")),
    *_FROM_LAYOUT,
)

PIPELINES: Pipelines = {
    SceneKind.IMAGE: STAGES,
    SceneKind.CAPTURE: STAGES,
    SceneKind.LAYOUT: (Stage("read_layout", "perception", read_layout, reads=("observe",)), *_FROM_LAYOUT),
}


def trajectories(
    scene: ExportedScene, config: Config, rng: np.random.Generator, services: Services
) -> Outcome[ExportedScene]:
    """The stage behind a door of its own: builds that ask for no motions do not load what plans them."""
    from tableverse_factory.stages.trajectories.trajectories import trajectories as run

    return run(scene, config, rng, services)


_TRAJECTORIES = Stage("trajectories", "trajectories", trajectories, reads=("trajectories",), adds=True)
WITH_TRAJECTORIES: Pipelines = {kind: (*line, _TRAJECTORIES) for kind, line in PIPELINES.items()}
"""The same lines, and motions for the tasks of what was exported: `--stages +trajectories`."""
