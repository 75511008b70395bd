"""Rows of one scene for the tables of `schemas.tables`."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from schemas.curation import Assessment, ObjectAssessment
from schemas.detection import DetectionRecord
from schemas.geometry import ConvexPieces
from schemas.objects import Evidence, PlacedObject
from schemas.scene import Certificate, CuratedScene
from tableverse_factory.geometry.math.aabb import aabb_size
from tableverse_factory.geometry.math.camera import compute_field_of_view_deg
from tableverse_factory.physics.mjcf.spec import SceneBody
from tableverse_factory.physics.simulate.sizes import SimulationSizes

_CERTIFICATE_COLUMNS = (
    *("epsilon_m", "piece_penetration_before_m", "mesh_penetration_before_m", "piece_penetration_m"),
    *("mesh_penetration_m", "drift_m", "drift_rad", "at_rest", "colliding"),
)
_VERDICT_COLUMNS = (
    *("relabel_name", "label_confidence", "label_error", "answered_mass_kg", "mass_clipped", "has_hinge"),
    *("hinge_category", "graspable", "bad_geometry", "non_tabletop"),
)


def _pick(record: object, *names: str) -> dict[str, Any]:
    return {name: getattr(record, name) for name in names}


def build_scene_row(scene: CuratedScene, certificate: Certificate, sizes: SimulationSizes) -> dict[str, Any]:
    """Build the columns of scenes/ that the scene itself knows; source, status and offsets are the executor's."""
    shifts = [shift for _, shift in certificate.displacement_m] or [0.0]
    placed, holds = scene.settled.rectified.placed, certificate.at_rest and not certificate.colliding
    return {
        "scene_id": scene.scene_id,
        **describe_metric(placed.evidence),
        "changes": list(placed.changes) or None,
        "perception": placed.perception,
        "judge": scene.judge,
        "mesh_licences": sorted({item.mesh_licence for item in placed.objects if item.mesh_licence}) or None,
        "n_objects": len(scene.settled.poses),
        "usable": scene.assessment.usable and holds,
        "quality_score": scene.assessment.quality_score,
        **_describe_detector(placed.detection),
        **_describe_judge(scene.assessment, holds),
        **_pick(certificate, *_CERTIFICATE_COLUMNS),
        "displacement_median_m": float(np.median(shifts)),
        "displacement_max_m": max(shifts),
        "n_fell": len(certificate.fell),
        "n_left_container": len(certificate.left_container),
        "settle_time_s": scene.settled.settle_time_s,
        **asdict(sizes),
    }


def _describe_detector(record: DetectionRecord | None) -> dict[str, Any]:
    if record is None:
        return {}
    remarks = [f"{r.rule}:{r.where}" if r.where else r.rule for r in record.remarks]
    model, prompt = record.origin.model, record.origin.prompt_sha256
    return {"detector_model": model, "detector_prompt_sha256": prompt, "detector_remarks": remarks}


def _describe_judge(verdict: Assessment, holds: bool) -> dict[str, Any]:
    origin, agreement = verdict.origin, verdict.agreement
    columns: dict[str, Any] = {
        "answered_usable": verdict.answered_usable,
        "answered_score": verdict.answered_score,
        "judge_remarks": [f"{r.code}:{r.object_id}" if r.object_id else r.code for r in verdict.remarks],
    }
    if origin.model:
        columns |= {"judge_model": origin.model, "judge_prompt_sha256": origin.prompt_sha256}
    if agreement is not None:
        columns |= {
            **_pick(agreement, "rules_score", "rules_tasks"),
            "rules_usable": agreement.rules_usable and holds,
            "rules_names_share": agreement.names_share,
            "rules_mass_ratio": agreement.mass_ratio,
            "rules_shared_tasks": agreement.shared_tasks,
        }
    return columns


def describe_metric(evidence: Evidence | None) -> dict[str, Any]:
    """Describe where metres and camera come from; a layout was given in metres, without a camera."""
    if evidence is None:
        return {"scale_source": "given"}
    is_known = evidence.scale_sigma > 0.0 or evidence.scale_source == "sensor"  # a model may tell no uncertainty
    sigma = evidence.scale_sigma if is_known else None
    columns = _pick(evidence, "scale_source", "scale_deviation", "intrinsics_source")
    return {**columns, "scale_sigma": sigma, "field_of_view_deg": compute_field_of_view_deg(evidence.camera)}


def build_object_rows(
    scene: CuratedScene, bodies: Sequence[SceneBody], certificate: Certificate
) -> tuple[dict[str, Any], ...]:
    """Build a row of objects/ per object, in their order."""
    rectified = scene.settled.rectified
    verdicts = {verdict.object_id: verdict for verdict in scene.assessment.objects}
    shifts = dict(certificate.displacement_m)
    return tuple(
        {
            "scene_id": scene.scene_id,
            **_describe_name(item, verdicts[item.object_id]),
            **_describe_body(body),
            "contained_in": None if item.object_id in certificate.left_container else item.contained_in,
            "copy_of": item.copy_of,
            "displacement_m": shifts.get(item.object_id),
            **_describe_mesh(item, pieces, body),
        }
        for item, pieces, body in zip(rectified.placed.objects, rectified.pieces, bodies, strict=True)
    )


def build_task_rows(scene: CuratedScene) -> tuple[dict[str, Any], ...]:
    """Build a row of tasks/ per task, also for the refused."""
    return tuple({"scene_id": scene.scene_id, **task.model_dump(mode="json")} for task in scene.assessment.tasks)


def _describe_name(item: PlacedObject, verdict: ObjectAssessment) -> dict[str, Any]:
    return {
        "object_id": item.object_id,
        "label": item.label,
        **_pick(verdict, *_VERDICT_COLUMNS),
        "distinguishing_phrases": list(verdict.distinguishing_phrases),
        "corrected_label": verdict.corrected_label or None,
        "from_rules": list(verdict.from_rules),
    }


def _describe_body(body: SceneBody) -> dict[str, Any]:
    columns = ("size_x_m", "size_y_m", "size_z_m", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
    values = (*aabb_size(body.mesh.vertices), *body.pose.position, *body.pose.quaternion_wxyz)
    return {**_pick(body.properties, "mass_kg", "volume_m3"), **dict(zip(columns, map(float, values), strict=True))}


def _describe_mesh(item: PlacedObject, pieces: ConvexPieces, body: SceneBody) -> dict[str, Any]:
    sure = item.uncertainty if item.copy_of is None else None
    return {
        **_pick(item, "fit_residual_m", "completion", "mesh_licence"),
        "position_std_m": sure and sure.position_std_m,
        "heading_std_rad": sure and sure.heading_std_rad,
        "heading_folds": sure and sure.heading_folds,
        "fit_ambiguity": sure and sure.ambiguity,
        "n_pieces": len(body.hulls),
        "piece_volume_ratio": pieces.volume_ratio,
        "piece_hausdorff_m": item.scale * pieces.hausdorff_m,
        "piece_uncovered_m": item.scale * pieces.uncovered_m,
        "cavity_kept": pieces.cavity_kept,
        "piece_method": pieces.method,
        "mesh_repaired": pieces.repaired,
    }
