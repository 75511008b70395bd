"""Writer of `meta.json`: what the MJCF cannot hold; `read_meta` reads it."""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass
from typing import Any

import numpy as np

from schemas.geometry import ConvexPieces, TriangleMesh
from schemas.objects import PlacedObjects
from schemas.scene import Certificate, CuratedScene
from tableverse_factory.dataset.scene_meta import FORMAT
from tableverse_factory.physics.mjcf.spec import TORSIONAL_FRICTION, SceneBody
from tableverse_factory.stages.export.fidelity import Fidelity
from tableverse_factory.stages.export.rows import describe_metric


def build_meta_json(
    scene: CuratedScene,
    bodies: Sequence[SceneBody],
    certificate: Certificate,
    fidelity: Fidelity,
    files: Mapping[str, bytes],
) -> bytes:
    """Build the file with sorted keys and shortest exact floats, so that equal scenes give equal bytes.

    It keeps the digests of `files`, all other files of the scene.
    """
    placed = scene.settled.rectified.placed
    evidence = placed.evidence
    content = {
        "format": FORMAT,
        "scene_id": scene.scene_id,
        "certificate": certificate,
        "table": placed.table,
        "camera": None if evidence is None else evidence.camera,
        "camera_to_table": None if evidence is None else evidence.camera_to_table,
        **({"metric": describe_metric(evidence)} if evidence and evidence.scale_source != "sensor" else {}),
        "perception": placed.perception,
        "detection": None if placed.detection is None else placed.detection.model_dump(mode="json"),
        "judge": scene.judge,
        "assessment": scene.assessment.model_dump(mode="json"),
        "left_out": [list(entry) for entry in placed.left_out],
        "rectified_by": scene.settled.rectified.method,
        "settle_time_s": scene.settled.settle_time_s,
        "fidelity": fidelity.scene,
        "objects": [
            {**entry, **columns}
            for entry, columns in zip(
                _describe_objects(scene, placed, bodies, certificate), fidelity.objects, strict=True
            )
        ],
        "files": compute_file_digests(files),
    }
    return json.dumps(_to_json_value(content), sort_keys=True, indent=1, allow_nan=False, ensure_ascii=False).encode()


def compute_file_digests(files: Mapping[str, bytes]) -> dict[str, dict[str, Any]]:
    """Compute size and SHA-256 of each file."""
    return {name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()} for name, data in files.items()}


def _describe_objects(
    scene: CuratedScene, placed: PlacedObjects, bodies: Sequence[SceneBody], certificate: Certificate
) -> list[dict[str, Any]]:
    rectified = scene.settled.rectified
    pixels: Sequence[int | None] = placed.evidence.object_pixels if placed.evidence else [None] * len(bodies)
    return [
        {
            "object_id": item.object_id,
            "label": item.label,
            "scale": item.scale,
            "contained_in": None if item.object_id in certificate.left_container else item.contained_in,
            "placed_in": item.contained_in,
            "copy_of": item.copy_of,
            "group": group,
            "completion": item.completion,
            "mesh_licence": item.mesh_licence,
            "fit_residual_m": item.fit_residual_m,
            "mask_value": value,
            "poses": {"placed": item.pose if item.copy_of is None else None, "rectified": before, "settled": body.pose},
            "pieces": _describe_pieces(pieces, item.scale, body),
            "appearance": _describe_appearance(item.mesh),
            "inertia_from": body.properties.source,
            "friction": [body.friction, TORSIONAL_FRICTION, body.rolling_friction],
        }
        for item, before, pieces, group, body, value in zip(
            placed.objects, rectified.poses, rectified.pieces, rectified.groups, bodies, pixels, strict=True
        )
    ]


def _describe_pieces(pieces: ConvexPieces, scale: float, body: SceneBody) -> dict[str, Any]:
    """Describe the convex pieces; lengths include the scale."""
    return {
        "count": len(body.hulls),
        "too_thin": body.dropped_pieces,
        "method": pieces.method,
        "volume_ratio": pieces.volume_ratio,
        "hausdorff_m": scale * pieces.hausdorff_m,
        "uncovered_m": scale * pieces.uncovered_m,
        "cavity_kept": pieces.cavity_kept,
        "repaired": pieces.repaired,
    }


def _describe_appearance(mesh: TriangleMesh) -> str:
    """Name the source of the colours: the mesh's own texture, its vertices (and the picture), or the palette."""
    if mesh.texture is not None:
        return "texture"
    return "palette" if mesh.vertex_colors is None else "vertex_colors"


def _to_json_value(value: Any) -> Any:
    """Convert to what JSON can hold: arrays as lists, dataclasses as objects, what is not finite as null."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return {str(key): _to_json_value(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_to_json_value(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
