"""The stage `place`: each object of the picture becomes a closed metric mesh that stands in the table frame."""

from dataclasses import replace

import numpy as np

from schemas.config import Config
from schemas.geometry import Points, TriangleMesh
from schemas.objects import PerceivedObject, PerceivedObjects, PlacedObject, PlacedObjects
from schemas.outcome import Done, Dropped, Outcome
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.registration.icp import PartialView
from tableverse_factory.geometry.registration.register import (
    STANDS_STD_M,
    estimate_uncertainty,
    measure_median_distance,
    register,
)
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.completion.completion import Completion
from tableverse_factory.stages.place.evidence import encode_evidence
from tableverse_factory.stages.place.interface import MESH_MODELS
from tableverse_factory.stages.place.vertex_colors import paint_vertices
from tableverse_factory.stages.place.view.object_view import ObjectView, measure_free_space, view_object
from tableverse_factory.stages.place.view.support_from_depth import DepthSupport, find_supports

MIN_POINTS = 30
MIN_BREADTH_M = 0.001
LEANING_STD_M, HIDDEN_STD_M = 0.005, 0.03
"""How well the height is known on which contents stand: of long ones, which reach the floor, and of others [m]."""


def place(
    item: PerceivedObjects, config: Config, rng: np.random.Generator, services: Services
) -> Outcome[PlacedObjects]:
    """Completes and registers every object (paper section 3.1); what cannot be is left out with its reason."""
    left_out = list(item.left_out)
    seen = _view_objects(item, left_out)
    complete = MESH_MODELS[config.place.mesh_model]
    answers = complete(item, [sighting for _, sighting in seen], config.place, rng, services)
    placed: list[PlacedObject] = []
    kept: list[PerceivedObject] = []
    for (perceived, sighting), answer in zip(seen, answers, strict=True):
        try:
            placed.append(_register_object(perceived, sighting, _given(answer)))
            kept.append(perceived)
        except GeometryError as error:
            left_out.append((perceived.object_id, str(error)))
    if not placed:
        detail = "; ".join(f"{name}: {reason}" for name, reason in left_out[:5]) or "no objects were perceived"
        return Dropped("nothing_placed", detail)
    names = {o.object_id for o in placed}
    return Done(
        PlacedObjects(
            scene_id=item.scene_id,
            table=item.table,
            objects=tuple(_drop_lost_container(o, names) for o in placed),
            evidence=encode_evidence(item, tuple(kept), config.export.jpeg_quality),
            perception=item.perception,
            left_out=tuple(left_out),
            detection=item.detection,
        )
    )


def _view_objects(scene: PerceivedObjects, left_out: list[tuple[str, str]]) -> list[tuple[PerceivedObject, ObjectView]]:
    """The objects of which enough was seen; the others are added to `left_out`."""
    supports = find_supports(scene)
    seen = []
    for perceived in scene.objects:
        try:
            seen.append((perceived, _view_one(scene, perceived, supports[perceived.object_id])))
        except GeometryError as error:
            left_out.append((perceived.object_id, str(error)))
    return seen


def _view_one(scene: PerceivedObjects, perceived: PerceivedObject, support: DepthSupport) -> ObjectView:
    if len(perceived.points_camera) < MIN_POINTS:
        raise GeometryError(f"{len(perceived.points_camera)} points are too few; at least {MIN_POINTS} are needed")
    if _measure_breadth(perceived.points_camera) < MIN_BREADTH_M:
        raise GeometryError(f"its {len(perceived.points_camera)} points lie on a line: no shape can be read from them")
    sighting = view_object(scene, perceived, support)
    if len(sighting.points) < MIN_POINTS:
        raise GeometryError(f"{len(sighting.points)} points with depth are too few; at least {MIN_POINTS} are needed")
    return sighting


def _given(answer: Completion | GeometryError) -> Completion:
    if isinstance(answer, GeometryError):
        raise answer
    return answer


def _register_object(perceived: PerceivedObject, sighting: ObjectView, completion: Completion) -> PlacedObject:
    mesh, pose = completion.mesh, completion.pose
    view = PartialView(
        sighting.points,
        sighting.eye,
        sighting.support_z,
        _estimate_support_std(perceived, sighting.support),
        lambda points: measure_free_space(sighting, points),
    )
    if pose is None:
        found = register(mesh, view)
        mesh, pose = TriangleMesh(mesh.vertices * found.size, mesh.faces, mesh.vertex_colors), found.pose
        uncertainty = found.uncertainty
    else:
        uncertainty = estimate_uncertainty(mesh, pose, view)
    return PlacedObject(
        object_id=perceived.object_id,
        label=perceived.label,
        label_confidence=perceived.score,
        mesh=mesh if mesh.vertex_colors is not None else paint_vertices(mesh, pose, sighting),
        scale=1.0,
        pose=pose,
        contained_in=perceived.contained_in,
        count=perceived.count,
        fit_residual_m=measure_median_distance(sighting.points, place_mesh(mesh, pose)),
        completion=completion.method,
        uncertainty=uncertainty,
        mesh_licence=completion.licence,
    )


def _estimate_support_std(perceived: PerceivedObject, support: DepthSupport) -> float:
    if perceived.contained_in is None:
        return STANDS_STD_M
    return LEANING_STD_M if support.leaning else HIDDEN_STD_M


def _drop_lost_container(item: PlacedObject, names: set[str]) -> PlacedObject:
    """Forgets a container that was itself left out."""
    if item.contained_in is None or item.contained_in in names:
        return item
    return replace(item, contained_in=None)


def _measure_breadth(points: Points) -> float:
    """Standard deviation of points across the line that fits them best [m]."""
    centred = points - points.mean(axis=0)
    return float(np.sqrt(max(np.linalg.eigvalsh(centred.T @ centred / len(points))[1], 0.0)))
