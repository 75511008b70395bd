"""What a judge is asked about: the settled objects as they stand in the table frame."""

from dataclasses import dataclass

import numpy as np

from schemas.geometry import Frozen, TriangleMesh, Vector3
from schemas.objects import Table
from schemas.scene import SettledScene
from tableverse_factory.geometry.meshes import bounds, placed_mesh
from tableverse_factory.physics.inertia import mass_properties


@dataclass(frozen=True, slots=True, eq=False)
class Item(Frozen):
    """One object of the case; judges count them from 0 in the scene's order.

    Attributes:
        mesh: As it stands, table frame [m].
        size: Extents of the scaled mesh along its own axes [m].
        volume_m3: Of the scaled mesh, of its pieces where it is open [m³].
    """

    object_id: str
    label: str
    confidence: float
    mesh: TriangleMesh
    size: Vector3
    volume_m3: float


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One scene to judge."""

    scene_id: str
    items: tuple[Item, ...]
    table: Table


def case_of(scene: SettledScene) -> Case:
    """The case of a settled scene."""
    placed = scene.rectified.placed
    items = []
    for thing, pose, pieces in zip(placed.objects, scene.poses, scene.rectified.pieces, strict=True):
        low, high = bounds(thing.mesh)
        volume = mass_properties(thing.mesh, pieces.hulls, 1.0).volume_m3
        items.append(
            Item(
                thing.object_id,
                thing.label,
                thing.label_confidence,
                placed_mesh(thing.mesh, pose, thing.scale),
                np.asarray((high - low) * thing.scale),
                float(volume) * thing.scale**3,
            )
        )
    return Case(scene.scene_id, tuple(items), placed.table)
