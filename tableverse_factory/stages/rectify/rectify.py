"""The stage: convex pieces of every mesh, containers filled, then LCCR."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from schemas.config import Config, RectifyConfig
from schemas.geometry import ConvexPieces
from schemas.objects import Evidence, PlacedObject, PlacedObjects
from schemas.outcome import Done, Dropped, Outcome
from schemas.scene import RectifiedLayout
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.collision.penetration import piece_penetrations
from tableverse_factory.geometry.convex.decompose import decompose
from tableverse_factory.geometry.math.aabb import size_around
from tableverse_factory.models.services import Services
from tableverse_factory.stages.rectify.composites import assemble
from tableverse_factory.stages.rectify.joint import joint
from tableverse_factory.stages.rectify.lccr import Rectified, lccr
from tableverse_factory.stages.rectify.rigid_part import RigidPart, part_of

MAX_REASON_CHARS = 300
SMALLEST_M = 0.001
LARGEST_M = 5.0

METHODS: dict[str, Callable[[Sequence[RigidPart], RectifyConfig], Rectified]] = {"lccr": lccr, "joint": joint}


def rectify(
    item: PlacedObjects,
    config: Config,
    rng: np.random.Generator,
    services: Services,
) -> Outcome[RectifiedLayout]:
    """Fills the containers of a layout, then moves its objects apart until nothing touches, on pieces and on meshes.

    Objects whose mesh no repair can save, and contents that do not fit, are left out with the reason; the rest goes on.
    """
    decomposed: dict[str, ConvexPieces] = {}
    refused: dict[str, str] = {}
    for placed in item.objects:
        try:
            check_size(placed)
            decomposed[placed.object_id] = decompose(placed.mesh, config.rectify, services.cache_dir)
        except GeometryError as error:
            refused[placed.object_id] = str(error)[:MAX_REASON_CHARS]
    if not decomposed:
        return Dropped("no_usable_mesh", f"none of {len(item.objects)} meshes can be decomposed: {refused}")
    kept = without(item, refused)
    pieces = tuple(decomposed[placed.object_id] for placed in kept.objects)
    depths = piece_penetrations(pieces, [o.pose for o in kept.objects], [o.scale for o in kept.objects])
    filled = assemble(kept, pieces, config, rng)
    parts = [
        part_of(replace(placed, pose=pose), its)
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


def check_size(placed: PlacedObject) -> None:
    """Refuses what cannot be a thing on a table.

    Raises:
        GeometryError: if the scaled mesh is smaller than 1 mm or larger than 5 m.
    """
    size = placed.scale * float(size_around(placed.mesh.vertices).max())
    if not SMALLEST_M <= size <= LARGEST_M:
        raise GeometryError(
            f"the object is {size:.3g} m large; on a table things measure {SMALLEST_M} to {LARGEST_M} m"
        )


def without(item: PlacedObjects, refused: dict[str, str]) -> PlacedObjects:
    """The layout without some objects, the reasons kept; what they contained stands on its own."""
    if not refused:
        return item
    keep = [placed.object_id not in refused for placed in item.objects]
    return replace(
        item,
        objects=tuple(_freed(placed, refused) for placed, kept in zip(item.objects, keep, strict=True) if kept),
        evidence=None if item.evidence is None else _masked(item.evidence, keep),
        left_out=(*item.left_out, *refused.items()),
    )


def _freed(placed: PlacedObject, refused: dict[str, str]) -> PlacedObject:
    return replace(placed, contained_in=None) if placed.contained_in in refused else placed


def _masked(evidence: Evidence, keep: list[bool]) -> Evidence:
    pixels = zip(evidence.object_pixels, keep, strict=True)
    return replace(evidence, object_pixels=tuple(value for value, kept in pixels if kept))
