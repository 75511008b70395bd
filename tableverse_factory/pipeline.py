"""THE LINE: the stages that a manifest row of each kind runs through, in order. The only place where stages meet."""

import numpy as np

from schemas.config import Config
from schemas.manifest import SceneKind
from schemas.outcome import Outcome
from schemas.scene import ExportedScene
from tableverse_factory.models.services import Services
from tableverse_factory.robotics.robots.recorded import record_robot
from tableverse_factory.stage import Pipelines, Stage
from tableverse_factory.stages.cousins.derive import derive_cousin
from tableverse_factory.stages.curate.curate import curate
from tableverse_factory.stages.curate.recorded import record_answers, record_prompts
from tableverse_factory.stages.export.export import export
from tableverse_factory.stages.observe.check import check_depth_model
from tableverse_factory.stages.observe.observe import observe, read_layout
from tableverse_factory.stages.observe.recorded import record_depth
from tableverse_factory.stages.perceive.check import check_perception_models
from tableverse_factory.stages.perceive.perceive import perceive
from tableverse_factory.stages.perceive.recorded import record_detector, record_segmenter
from tableverse_factory.stages.place.place import place
from tableverse_factory.stages.rectify.rectify import rectify
from tableverse_factory.stages.settle import settle
from tableverse_factory.stages.trajectories.failed_rows import with_failed_trajectories

_OBSERVE = Stage(
    "observe",
    "perception",
    observe,
    reads=("observe", "place.mesh_model", "models"),
    recorded={"depth": record_depth},
    check=check_depth_model,
)
_PERCEIVE = Stage(
    "perceive",
    "perception",
    perceive,
    reads=("perceive", "models"),
    recorded={"detector": record_detector, "segmenter": record_segmenter},
    check=check_perception_models,
)
_CURATE = Stage(
    "curate", "curation", curate, reads=("curate",), recorded={"answers": record_answers, "prompts": record_prompts}
)

_FROM_LAYOUT = (
    Stage("rectify", "geometry", rectify, reads=("rectify", "settle.timestep_s")),
    Stage("settle", "physics", settle, reads=("settle",)),
    _CURATE,
    Stage("export", "physics", export, reads=("export", "settle")),
)

_PLACE = Stage("place", "geometry", place, reads=("place", "export.jpeg_quality", "perceive.min_explained"))
STAGES = (_OBSERVE, _PERCEIVE, _PLACE, *_FROM_LAYOUT)

PIPELINES: Pipelines = {
    SceneKind.IMAGE: STAGES,
    SceneKind.CAPTURE: STAGES,
    SceneKind.LAYOUT: (Stage("read_layout", "perception", read_layout, reads=("observe",)), *_FROM_LAYOUT),
    SceneKind.COUSIN: (Stage("derive_cousin", "geometry", derive_cousin, reads=("observe",)), *_FROM_LAYOUT),
}


def run_trajectories(
    scene: ExportedScene, config: Config, rng: np.random.Generator, services: Services
) -> Outcome[ExportedScene]:
    """Plan trajectories, importing the planners only in builds that ask for them."""
    from tableverse_factory.stages.trajectories.trajectories import plan_trajectories

    return plan_trajectories(scene, config, rng, services)


_TRAJECTORIES = Stage(
    "trajectories",
    "trajectories",
    run_trajectories,
    reads=("trajectories",),
    recorded={"robot": record_robot},
    record_failure=with_failed_trajectories,
)
WITH_TRAJECTORIES: Pipelines = {kind: (*line, _TRAJECTORIES) for kind, line in PIPELINES.items()}
"""The same pipelines, with trajectories for the tasks of exported scenes: `--stages +trajectories`."""
