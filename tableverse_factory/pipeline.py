"""THE LINE: the stages that a manifest row of each kind runs through, in order. The only place where stages meet."""

from schemas.manifest import SceneKind
from tableverse_factory.robotics.robots.recorded import record_robot
from tableverse_factory.stage import DeferredFunction, Pipelines, Stage
from tableverse_factory.stages.curate.recorded import record_answers, record_prompts
from tableverse_factory.stages.observe.check import check_depth_model
from tableverse_factory.stages.observe.recorded import record_depth
from tableverse_factory.stages.perceive.check import check_perception_models
from tableverse_factory.stages.perceive.recorded import record_detector, record_segmenter
from tableverse_factory.stages.trajectories.failed_rows import with_failed_trajectories


def _defer(address: str) -> DeferredFunction:
    """Return the function at `module:name` below `stages`, which whoever only plans a build does not import."""
    return DeferredFunction(f"tableverse_factory.stages.{address}")


_OBSERVE = Stage(
    "observe",
    "perception",
    _defer("observe.observe:observe"),
    reads=("observe", "place.mesh_model", "models"),
    recorded={"depth": record_depth},
    check=check_depth_model,
)
_PERCEIVE = Stage(
    "perceive",
    "perception",
    _defer("perceive.perceive:perceive"),
    reads=("perceive", "models"),
    recorded={"detector": record_detector, "segmenter": record_segmenter},
    check=check_perception_models,
)
_CURATE = Stage(
    "curate",
    "curation",
    _defer("curate.curate:curate"),
    reads=("curate",),
    recorded={"answers": record_answers, "prompts": record_prompts},
)

_FROM_LAYOUT = (
    Stage("rectify", "geometry", _defer("rectify.rectify:rectify"), reads=("rectify", "settle.timestep_s")),
    Stage("settle", "physics", _defer("settle:settle"), reads=("settle",)),
    _CURATE,
    Stage("export", "physics", _defer("export.export:export"), reads=("export", "settle")),
)

_PLACE = Stage(
    "place",
    "geometry",
    _defer("place.place:place"),
    reads=("place", "export.jpeg_quality", "perceive.min_explained"),
)
STAGES = (_OBSERVE, _PERCEIVE, _PLACE, *_FROM_LAYOUT)

PIPELINES: Pipelines = {
    SceneKind.IMAGE: STAGES,
    SceneKind.CAPTURE: STAGES,
    SceneKind.LAYOUT: (
        Stage("read_layout", "perception", _defer("observe.observe:read_layout"), reads=("observe",)),
        *_FROM_LAYOUT,
    ),
    SceneKind.COUSIN: (
        Stage("derive_cousin", "geometry", _defer("cousins.derive:derive_cousin"), reads=("observe",)),
        *_FROM_LAYOUT,
    ),
}

_TRAJECTORIES = Stage(
    "trajectories",
    "trajectories",
    _defer("trajectories.trajectories:plan_trajectories"),
    reads=("trajectories",),
    recorded={"robot": record_robot},
    record_failure=with_failed_trajectories,
)
WITH_TRAJECTORIES: Pipelines = {kind: (*line, _TRAJECTORIES) for kind, line in PIPELINES.items()}
"""The same pipelines, with trajectories for the tasks of exported scenes: `--stages +trajectories`."""
