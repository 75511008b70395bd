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
    Stage("rectify", "geometry", rectify),
    Stage("settle", "physics", settle),
    Stage("curate", "curation", curate),
    Stage("export", "curation", export),
)

STAGES = (
    Stage("observe", "perception", observe),
    Stage("perceive", "perception", perceive),
    Stage("place", "geometry", place),
    *_FROM_LAYOUT,
)

LINES = {
    SceneKind.IMAGE: STAGES,
    SceneKind.CAPTURE: STAGES,
    SceneKind.LAYOUT: (Stage("read_layout", "perception", read_layout), *_FROM_LAYOUT),
}
