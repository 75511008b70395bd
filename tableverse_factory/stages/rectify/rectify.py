"""The stage: convex pieces of every mesh, containers filled, then LCCR."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import compress

import numpy as np

from schemas.config import Config, RectifyConfig
from schemas.geometry import ConvexPieces
from schemas.objects import LARGEST_M, SMALLEST_M, PlacedObject, PlacedObjects
from schemas.outcome import Done, Dropped, Outcome
from schemas.scene import RectifiedLayout
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.collision.penetration import measure_piece_penetrations
from tableverse_factory.geometry.convex.decompose import decompose
from tableverse_factory.geometry.math.aabb import aabb_size
from tableverse_factory.models.services import Services
from tableverse_factory.physics.bodies.prior_mass import make_prior_body
from tableverse_factory.stages.rectify.composites import assemble_composites
from tableverse_factory.stages.rectify.joint import rectify_jointly
from tableverse_factory.stages.rectify.lccr import RectificationResult, rectify_lccr
from tableverse_factory.stages.rectify.rigid_part import RigidPart, make_rigid_part

MAX_REASON_CHARS = 300

METHODS: dict[str, Callable[[Sequence[RigidPart], RectifyConfig], RectificationResult]] = {
    "lccr": rectify_lccr,
    "joint": rectify_jointly,
}


def rectify(
    item: PlacedObjects, config: Config, rng: np.random.Generator, services: Services
) -> Outcome[RectifiedLayout]:
    """Fill the containers of a layout, then move its objects apart until none touch, on pieces and on meshes.

    Objects with meshes that cannot be repaired or simulated, and contents that do not fit, are left out with a reason.
    """
    decomposed: dict[str, ConvexPieces] = {}
    refused: dict[str, str] = {}
    for placed in item.objects:
        try:
            _check_size(placed)
            pieces = placed.pieces or decompose(placed.mesh, config.rectify, services.cache_dir)
            make_prior_body(placed, pieces, placed.pose)  # settling refuses what is too thin, and the scene with it
            decomposed[placed.object_id] = pieces
        except GeometryError as error:
            refused[placed.object_id] = str(error)[:MAX_REASON_CHARS]
    if not decomposed:
        return Dropped("no_usable_mesh", f"none of {len(item.objects)} meshes can be decomposed: {refused}")
    kept = _remove_objects(item, refused)
    all_pieces = tuple(decomposed[placed.object_id] for placed in kept.objects)
    depths = measure_piece_penetrations(all_pieces, [o.pose for o in kept.objects], [o.scale for o in kept.objects])
    filled = assemble_composites(kept, all_pieces, config, rng)
    parts = [
        make_rigid_part(replace(placed, pose=pose), its)
        for placed, pose, its in zip(filled.placed.objects, filled.poses, filled.pieces, strict=True)
    ]
    result = METHODS[config.rectify.method](parts, config.rectify)
    group_of = {i: k for k, group in enumerate(result.groups) for entity in group for i in entity}
    return Done(
        RectifiedLayout(
            scene_id=item.scene_id,
            placed=filled.placed,
            pieces=filled.pieces,
            poses=tuple(part.pose_now(pose) for pose, part in zip(filled.poses, result.parts, strict=True)),
            groups=tuple(group_of[i] for i in range(len(result.parts))),
            penetration_before_m=max((depth for _, _, depth in depths), default=0.0),
            method=result.method,
        )
    )


def _check_size(placed: PlacedObject) -> None:
    size = placed.scale * float(aabb_size(placed.mesh.vertices).max())
    if not SMALLEST_M <= size <= LARGEST_M:
        raise GeometryError(f"the object is {size:.3g} m large; give objects of {SMALLEST_M} to {LARGEST_M} m")


def _remove_objects(item: PlacedObjects, refused: dict[str, str]) -> PlacedObjects:
    """Remove refused objects, keeping the reasons; their contents stand on their own."""
    if not refused:
        return item
    keep = [placed.object_id not in refused for placed in item.objects]
    objects = (
        replace(placed, contained_in=None) if placed.contained_in in refused else placed
        for placed in compress(item.objects, keep)
    )
    evidence = item.evidence
    if evidence is not None:
        evidence = replace(evidence, object_pixels=tuple(compress(evidence.object_pixels, keep)))
    return replace(item, objects=tuple(objects), evidence=evidence, left_out=(*item.left_out, *refused.items()))
