"""Columns of a scene and its objects about their agreement with the photograph."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from schemas.scene import CuratedScene
from tableverse_factory.geometry.relations.displacement import measure_displacement
from tableverse_factory.geometry.relations.misfit import find_misfits
from tableverse_factory.physics.mjcf.spec import SceneBody


@dataclass(frozen=True, slots=True)
class Fidelity:
    """Columns of the scene, and of each object in their order."""

    scene: dict[str, Any]
    objects: tuple[dict[str, Any], ...]


def describe_fidelity(scene: CuratedScene, bodies: Sequence[SceneBody]) -> Fidelity:
    """Describe what the exported bodies explain and cover, and what toppled, slid, is left out or misfits."""
    placed, coverage = scene.settled.rectified.placed, scene.coverage
    ids = [item.object_id for item in placed.objects]
    moved = [measure_displacement(item, body.pose) for item, body in zip(placed.objects, bodies, strict=True)]
    kinds = ["" if displacement is None else displacement.kind for displacement in moved]
    covered: Sequence[float | None] = [None] * len(ids) if coverage is None else coverage.of_objects
    points, area = (None, None) if placed.explanation is None else placed.explanation.measure_shares(ids)
    remarks = [
        *(f"{kind}:{name}" for name, kind in zip(ids, kinds, strict=True) if kind),
        *(f"left_out:{name}" for name, _ in placed.left_out),
        *(f"poorly_covered:{ids[index]}" for index in (coverage.poor if coverage else ())),
        *(f"misfit:{ids[index]}" for index in find_misfits(placed)),
    ]
    columns = {
        "explained_points": points,
        "explained_area": area,
        "coverage": coverage and coverage.whole,
        "n_toppled": kinds.count("toppled"),
        "n_slid": kinds.count("slid"),
        "n_left_out": len(placed.left_out),
        "twin_remarks": remarks,
    }
    return Fidelity(
        columns,
        tuple(
            {"tilt_rad": displacement and displacement.tilt_rad, "coverage": share}
            for displacement, share in zip(moved, covered, strict=True)
        ),
    )
