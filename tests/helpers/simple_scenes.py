"""Scenes of boxes, balls and cylinders, whose truth is known on paper; each is its own convex piece."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from schemas.curation import Assessment, ObjectAssessment, TaskAssessment
from schemas.geometry import ConvexPieces, Pose, TriangleMesh
from schemas.objects import Evidence, PlacedObject, PlacedObjects, Table
from schemas.scene import CuratedScene, RectifiedLayout, SettledScene
from tableverse_factory.geometry.mesh.meshes import from_trimesh

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
TABLE = Table(np.zeros(2), np.array([0.3, 0.2]), 0.0, (150, 120, 90), 0.0)


@dataclass(frozen=True)
class Solid:
    """One object of a test scene."""

    mesh: TriangleMesh
    position: tuple[float, float, float]
    label: str = "wooden block"
    object_id: str = ""
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    contained_in: str | None = None
    scale: float = 1.0
    hulls: tuple[TriangleMesh, ...] = ()

    @property
    def pose(self) -> Pose:
        return Pose(np.array(self.position), np.array(self.quaternion) / np.linalg.norm(self.quaternion))


def box(x: float, y: float, z: float) -> TriangleMesh:
    return from_trimesh(trimesh.creation.box((x, y, z)))


def ball(radius: float) -> TriangleMesh:
    return from_trimesh(trimesh.creation.icosphere(1, radius))


def cylinder(radius: float, height: float, sections: int = 32) -> TriangleMesh:
    return from_trimesh(trimesh.creation.cylinder(radius, height, sections=sections))


def layout(
    solids: Sequence[Solid], table: Table = TABLE, scene_id: str = "scene", evidence: Evidence | None = None
) -> RectifiedLayout:
    ids = [solid.object_id or f"obj_{index:03d}" for index, solid in enumerate(solids)]
    objects = tuple(
        PlacedObject(i, s.label, 1.0, s.mesh, s.scale, s.pose, contained_in=s.contained_in)
        for i, s in zip(ids, solids, strict=True)
    )
    return RectifiedLayout(
        scene_id,
        PlacedObjects(scene_id, table, objects, evidence),
        tuple(ConvexPieces(s.hulls or (s.mesh,), 1.0, 0.0, "convex") for s in solids),
        tuple(s.pose for s in solids),
        tuple(range(len(solids))),
        0.0,
    )


def as_settled(rectified: RectifiedLayout) -> SettledScene:
    """As if settling had moved nothing."""
    return SettledScene(rectified.scene_id, rectified, rectified.poses, 0.2)


def curated(
    settled: SettledScene, mass_kg: float = 0.2, tasks: tuple[TaskAssessment, ...] = (), names: Sequence[str] = ()
) -> CuratedScene:
    """As if a judge had called the objects `names`, by default as they are labelled."""
    objects = settled.rectified.placed.objects
    verdicts = tuple(
        ObjectAssessment(
            object_id=item.object_id,
            relabel_name=name,
            distinguishing_phrases=(f"the {name}",),
            label_confidence=1.0,
            mass_kg=mass_kg * (1 + 0.1 * index),
        )
        for index, (item, name) in enumerate(zip(objects, names or [item.label for item in objects], strict=True))
    )
    assessment = Assessment(usable=True, quality_score=7, criterion_scores={}, objects=verdicts, tasks=tasks)
    return CuratedScene(settled.scene_id, settled, "rules", assessment)
