"""THE LINE: which stages a row of the manifest runs through, in order. The only place where stages meet."""

from schemas.manifest import SceneKind
from tableverse_factory.curate.curate import curate
from tableverse_factory.export.export import export
from tableverse_factory.observe import observe, read_layout
from tableverse_factory.perceive.perceive import perceive
from tableverse_factory.place.place import place
from tableverse_factory.rectify.rectify import rectify
from tableverse_factory.settle import settle
from tableverse_factory.stage import Stage

_FROM_LAYOUT = (
    Stage("rectify", "geometry", rectify, reads=("rectify", "settle.timestep_s")),
    Stage("settle", "physics", settle, reads=("settle",)),
    Stage("curate", "curation", curate, reads=("curate",)),
    Stage("export", "physics", export, reads=("export", "settle")),
)

STAGES = (
    Stage("observe", "perception", observe, reads=("observe", "place.mesh_model")),
    Stage("perceive", "perception", perceive, reads=("perceive",)),
    Stage("place", "geometry", place, reads=("place", "export.jpeg_quality")),
    *_FROM_LAYOUT,
)

LINES = {
    SceneKind.IMAGE: STAGES,
    SceneKind.CAPTURE: STAGES,
    SceneKind.LAYOUT: (Stage("read_layout", "perception", read_layout, reads=("observe",)), *_FROM_LAYOUT),
}
