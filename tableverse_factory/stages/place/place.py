"""The stage `place`: each object of the picture becomes a closed metric mesh in the table frame."""

import io
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from PIL import Image

from schemas.config import Config
from schemas.geometry import TriangleMesh
from schemas.objects import Evidence, PerceivedObject, PerceivedObjects, PlacedObject, PlacedObjects
from schemas.outcome import Done, Dropped, Outcome
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.core.png import encode_png
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.registration.icp import PartialView
from tableverse_factory.geometry.registration.register import (
    STANDS_STD_M,
    estimate_uncertainty,
    measure_median_distance,
    register,
)
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.interfaces import Completion
from tableverse_factory.stages.place.registry import MESH_MODELS
from tableverse_factory.stages.place.vertex_colors import paint_vertices
from tableverse_factory.stages.place.view.object_view import ObjectView, measure_free_space, view_object
from tableverse_factory.stages.place.view.support_from_depth import DepthSupport, find_supports

MIN_POINTS = 30
MIN_BREADTH_M = 0.001
MISSED_M = 0.002  # median distance of the readings from a shape, from which their depth is wrong [m]
LEANING_STD_M, HIDDEN_STD_M = 0.005, 0.03  # of the height on which contents stand: of long ones at the floor, of others
MAX_MASK_VALUE = 65_535


def place(
    item: PerceivedObjects, config: Config, rng: np.random.Generator, services: Services
) -> Outcome[PlacedObjects]:
    """Complete and register every object (paper section 3.1); objects that fail are left out with the reason."""
    left_out = list(item.left_out)
    seen = _view_objects(item, left_out)
    complete = MESH_MODELS[config.place.mesh_model]
    answers = complete(item, [view for _, view in seen], config.place, rng, services)
    placed: list[PlacedObject] = []
    kept: list[tuple[PerceivedObject, ObjectView]] = []
    for (perceived, view), answer in zip(seen, answers, strict=True):
        try:
            if isinstance(answer, GeometryError):
                raise answer
            placed.append(_register_object(perceived, view, answer))
            kept.append((perceived, view))
        except GeometryError as error:
            left_out.append((perceived.object_id, str(error)))
    if not placed:
        detail = "; ".join(f"{name}: {reason}" for name, reason in left_out[:5]) or "no objects were perceived"
        return Dropped("nothing_placed", detail)
    names = {o.object_id for o in placed}
    explanation, least = item.explanation, config.perceive.min_explained
    if explanation is not None and (why := explanation.describe_shortfall(names, least)):
        return Dropped("too_little_explained", why)
    return Done(
        PlacedObjects(
            scene_id=item.scene_id,
            table=item.table,
            objects=tuple(o if o.contained_in in names else replace(o, contained_in=None) for o in placed),
            evidence=_encode_evidence(item, kept, config.export.jpeg_quality),
            perception=item.perception,
            left_out=tuple(left_out),
            detection=item.detection,
            explanation=explanation,
        )
    )


def _view_objects(scene: PerceivedObjects, left_out: list[tuple[str, str]]) -> list[tuple[PerceivedObject, ObjectView]]:
    """View the objects of which enough was observed; the others are added to `left_out`."""
    supports = find_supports(scene.objects, scene.camera_to_table)
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
    centred = perceived.points_camera - perceived.points_camera.mean(axis=0)
    across = np.linalg.eigvalsh(centred.T @ centred / len(centred))[1]  # from the line that fits the points best [m²]
    if np.sqrt(max(across, 0.0)) < MIN_BREADTH_M:
        raise GeometryError(f"its {len(perceived.points_camera)} points lie on a line: no shape can be read from them")
    view = view_object(scene, perceived, support)
    if len(view.points) < MIN_POINTS:
        raise GeometryError(f"{len(view.points)} points with depth are too few; at least {MIN_POINTS} are needed")
    return view


def _register_object(perceived: PerceivedObject, view: ObjectView, completion: Completion) -> PlacedObject:
    mesh, pose = completion.mesh, completion.pose
    hidden_std_m = LEANING_STD_M if view.support.leaning else HIDDEN_STD_M
    support_std_m = STANDS_STD_M if perceived.contained_in is None else hidden_std_m
    partial = PartialView(
        view.points, view.eye, view.support_z, support_std_m, lambda points: measure_free_space(view, points)
    )
    if pose is None:
        found = register(mesh, partial)
        mesh, pose = TriangleMesh(mesh.vertices * found.size, mesh.faces, mesh.vertex_colors), found.pose
        uncertainty = found.uncertainty
    else:
        uncertainty = estimate_uncertainty(mesh, pose, partial)
    residual_m = measure_median_distance(view.points, place_mesh(mesh, pose))
    if mesh.vertex_colors is None:
        mesh = paint_vertices(mesh, pose, view, projected=view.estimated or residual_m > MISSED_M)
    return PlacedObject(
        object_id=perceived.object_id,
        label=perceived.label,
        label_confidence=perceived.score,
        mesh=mesh,
        scale=1.0,
        pose=pose,
        contained_in=perceived.contained_in,
        count=perceived.count,
        fit_residual_m=residual_m,
        completion=completion.method,
        uncertainty=uncertainty,
        mesh_licence=completion.licence,
    )


def _encode_evidence(
    scene: PerceivedObjects, objects: Sequence[tuple[PerceivedObject, ObjectView]], jpeg_quality: int
) -> Evidence:
    """Encode the picture, its instance ids and the camera for the dataset; `object_pixels` follows `objects`.

    The ids of an object are what its view holds: colour of the table that smeared depth gave to it is not its own.
    """
    color = io.BytesIO()
    Image.fromarray(np.asarray(scene.observation.color)).save(color, "JPEG", quality=jpeg_quality)
    ids = np.maximum(scene.instance_ids, 0)
    for perceived, view in objects:
        part = ids[view.window]
        part[(part == perceived.instance_id) & ~view.own] = 0
    if int(ids.max(initial=0)) > MAX_MASK_VALUE:
        raise GeometryError(f"instance id {int(ids.max())}: masks hold at most {MAX_MASK_VALUE}")
    return Evidence(
        color_jpg=color.getvalue(),
        masks_png=encode_png(ids.astype(np.uint16), compress_level=6),
        object_pixels=tuple(perceived.instance_id for perceived, _ in objects),
        camera=scene.observation.camera,
        camera_to_table=scene.camera_to_table,
        scale_source=scene.observation.scale_source,
        scale_sigma=scene.observation.scale_sigma,
        intrinsics_source=scene.observation.intrinsics_source,
        scale_deviation=scene.observation.scale_deviation,
    )
