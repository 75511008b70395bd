"""The MeshModel door: whatever turns the sighting of one object into a closed mesh."""

from collections.abc import Callable

from tableverse_factory.place.complete import complete_carved
from tableverse_factory.place.completion import Completion
from tableverse_factory.place.sighting import Sighting

MeshModel = Callable[[Sighting], Completion]
"""Raises GeometryError where what was seen does not carry a mesh."""

MESH_MODELS: dict[str, MeshModel] = {"carved": complete_carved}
