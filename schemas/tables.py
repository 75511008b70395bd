"""Arrow schemas of the stored tables, and the normal form of their rows; docs/formats.md describes every column."""

from collections.abc import Mapping
from typing import Any

import pyarrow as pa

from schemas.manifest import ImageRow

MANIFEST = pa.schema([(name, pa.string()) for name in ImageRow.model_fields])

SCENES = pa.schema(
    [
        ("scene_id", pa.string()),
        ("kind", pa.string()),
        ("name", pa.string()),
        ("url", pa.string()),  # that the picture was fetched from, by a list of addresses
        ("source", pa.string()),
        ("uri", pa.string()),
        ("licence", pa.string()),
        ("licence_verdict", pa.string()),  # dataset.licences.LicenceVerdict of the picture and the meshes together
        ("content_sha256", pa.string()),  # of the input, as the manifest saw it
        ("status", pa.string()),  # done | dropped | failed
        ("stage", pa.string()),  # the last stage that ran
        ("reason", pa.string()),  # code of a drop
        ("error_kind", pa.string()),  # kind of a failure
        ("detail", pa.string()),  # one line for people, of a drop or a failure
        ("attempts", pa.int32()),
        ("known_length", pa.string()),  # of the manifest
        ("parent", pa.string()),  # this and the next two are null for all but cousins
        ("recipe", pa.string()),  # what was planned to change, of the manifest
        ("changes", pa.list_(pa.string())),  # what was changed; null unless done
        ("family", pa.string()),  # the scene itself, or the first ancestor of a cousin
        ("split", pa.string()),  # train | validation | test, of the family
        ("scale_source", pa.string()),  # sensor | estimated | measured | given
        ("scale_sigma", pa.float64()),  # relative standard deviation; null for layouts, and where nothing tells it
        ("scale_deviation", pa.float64()),  # of a known length from the estimate, in standard deviations; or null
        ("intrinsics_source", pa.string()),  # capture | exif | sheet | model | assumed; null for layouts, as the next
        ("field_of_view_deg", pa.float64()),  # of the camera, over the longer side
        ("perception", pa.string()),
        ("judge", pa.string()),
        ("mesh_licences", pa.list_(pa.string())),  # of the objects' meshes, each once; null where no model made any
        ("n_objects", pa.int32()),
        ("usable", pa.bool_()),
        ("quality_score", pa.int32()),
        ("answered_usable", pa.bool_()),  # the judge's own word, before the checks
        ("answered_score", pa.int32()),
        ("judge_remarks", pa.list_(pa.string())),  # codes of what the checks of the verdict corrected
        ("judge_model", pa.string()),  # null where no model was asked, and so is the next
        ("judge_prompt_sha256", pa.string()),
        ("detector_model", pa.string()),  # null where no model was asked, and so are the next two
        ("detector_prompt_sha256", pa.string()),
        ("detector_remarks", pa.list_(pa.string())),  # rule:place, of what was left out of its answer or put right
        ("detector_calls", pa.int64()),  # requests; this and the next seven are null where no model was asked
        ("detector_input_tokens", pa.int64()),
        ("detector_output_tokens", pa.int64()),
        ("detector_usd", pa.float64()),  # what the answers cost when they were first given, as all of these
        ("judge_calls", pa.int64()),
        ("judge_input_tokens", pa.int64()),
        ("judge_output_tokens", pa.int64()),
        ("judge_usd", pa.float64()),
        ("rules_usable", pa.bool_()),  # agreement with the rules; null where they judged
        ("rules_score", pa.int32()),
        ("rules_names_share", pa.float64()),
        ("rules_mass_ratio", pa.float64()),
        ("rules_tasks", pa.int32()),
        ("rules_shared_tasks", pa.int32()),
        ("epsilon_m", pa.float64()),
        ("piece_penetration_before_m", pa.float64()),
        ("mesh_penetration_before_m", pa.float64()),
        ("piece_penetration_m", pa.float64()),
        ("mesh_penetration_m", pa.float64()),
        ("drift_m", pa.float64()),
        ("drift_rad", pa.float64()),
        ("displacement_median_m", pa.float64()),
        ("displacement_max_m", pa.float64()),
        ("n_fell", pa.int32()),
        ("n_left_container", pa.int32()),
        ("explained_points", pa.float64()),  # shares of what stands above the table; null without a photograph
        ("explained_area", pa.float64()),
        ("coverage", pa.float64()),  # of the masks, by the twin from the camera; null without a photograph
        ("n_toppled", pa.int32()),  # since the picture, as the next
        ("n_slid", pa.int32()),
        ("n_left_out", pa.int32()),
        ("twin_remarks", pa.list_(pa.string())),  # code:object: toppled, slid, left out, poorly covered, misfit
        ("at_rest", pa.bool_()),
        ("colliding", pa.bool_()),
        ("settle_time_s", pa.float64()),  # simulated
        ("nv", pa.int32()),  # this and the next two: sizes for simulators that allot memory first
        ("nconmax", pa.int32()),
        ("njmax", pa.int32()),
        ("n_trajectories", pa.int32()),  # tasks that were tried; null where no trajectories were asked for
        ("n_successes", pa.int32()),  # those of them that succeeded
        ("shard", pa.int32()),
        ("tar_offset", pa.int64()),  # of the scene's first tar header; null unless done
        ("tar_size", pa.int64()),  # bytes of all its members with headers and padding
    ]
)

OBJECTS = pa.schema(
    [
        ("scene_id", pa.string()),
        ("object_id", pa.string()),
        ("label", pa.string()),
        ("relabel_name", pa.string()),
        ("distinguishing_phrases", pa.list_(pa.string())),
        ("label_confidence", pa.float64()),
        ("label_error", pa.bool_()),
        ("corrected_label", pa.string()),
        ("from_rules", pa.list_(pa.string())),  # parts that the judge left out
        ("mass_kg", pa.float64()),
        ("answered_mass_kg", pa.float64()),  # the judge's own word; null where the rules filled it in
        ("mass_clipped", pa.bool_()),
        ("volume_m3", pa.float64()),
        ("has_hinge", pa.bool_()),
        ("hinge_category", pa.string()),
        ("graspable", pa.bool_()),
        ("bad_geometry", pa.bool_()),
        ("non_tabletop", pa.bool_()),
        ("contained_in", pa.string()),
        ("copy_of", pa.string()),  # the content whose mesh it repeats, where it was counted and not seen by itself
        ("size_x_m", pa.float64()),  # extents of the scaled mesh along its own axes
        ("size_y_m", pa.float64()),
        ("size_z_m", pa.float64()),
        ("x_m", pa.float64()),  # exported pose: the mesh's own frame in the table frame
        ("y_m", pa.float64()),
        ("z_m", pa.float64()),
        ("qw", pa.float64()),
        ("qx", pa.float64()),
        ("qy", pa.float64()),
        ("qz", pa.float64()),
        ("displacement_m", pa.float64()),  # of its box centre, from where the picture put it; null for copies
        ("tilt_rad", pa.float64()),  # since then, of its vertical axis; null for copies
        ("coverage", pa.float64()),  # of its mask, by the twin from the camera; null for copies and layouts
        ("fit_residual_m", pa.float64()),
        ("position_std_m", pa.float64()),  # this and the next three are null for layouts and copies
        ("heading_std_rad", pa.float64()),  # null for round things too
        ("heading_folds", pa.int32()),
        ("fit_ambiguity", pa.float64()),
        ("completion", pa.string()),
        ("mesh_licence", pa.string()),  # of the model that made the mesh; null where none did
        ("n_pieces", pa.int32()),
        ("piece_volume_ratio", pa.float64()),
        ("piece_hausdorff_m", pa.float64()),  # of the scaled object, as the two below
        ("piece_uncovered_m", pa.float64()),
        ("cavity_kept", pa.float64()),
        ("piece_method", pa.string()),
        ("mesh_repaired", pa.string()),
    ]
)

TASKS = pa.schema(
    [
        ("scene_id", pa.string()),
        ("task_id", pa.string()),
        ("instruction", pa.string()),
        ("x_id", pa.string()),
        ("y_id", pa.string()),
        ("relation", pa.string()),
        ("source", pa.string()),
        ("accepted", pa.bool_()),
        ("refusal", pa.string()),
    ]
)

TRAJECTORIES = pa.schema(
    [
        ("scene_id", pa.string()),
        ("task_id", pa.string()),
        ("x_id", pa.string()),
        ("y_id", pa.string()),
        ("relation", pa.string()),
        ("instruction", pa.string()),
        ("success", pa.bool_()),
        ("failed_phase", pa.string()),  # schemas.trajectories.Phase, or null: in success, and before any motion
        ("reason", pa.string()),  # code of a failure
        ("detail", pa.string()),  # one line for people, of a failure
        ("robot", pa.string()),
        ("grasp_model", pa.string()),
        ("planner", pa.string()),
        ("grasp_stage", pa.int32()),  # 1 strict top-down, 2 hemisphere, 3 confidence alone
        ("grasp_score", pa.float64()),
        ("grasp_candidates", pa.int32()),  # that were free of the scene
        ("tried", pa.int32()),  # pairs of grasp and placement
        ("duration_s", pa.float64()),  # of the motion
        ("lifted_m", pa.float64()),
        ("disturbed_m", pa.float64()),  # largest displacement of any other object
        ("survives", pa.list_(pa.string())),  # names of the changes of friction and mass under which it succeeds too
        ("base_x_m", pa.float64()),  # the robot's base in the table frame
        ("base_y_m", pa.float64()),
        ("base_z_m", pa.float64()),
        ("base_yaw_rad", pa.float64()),
        ("arrays", pa.string()),  # the scene's file with the motion; null where there is none
        ("arrays_sha256", pa.string()),  # of that file
        ("fallbacks", pa.list_(pa.string())),  # what the motion settled for, in words; null where none was executed
    ]
)

TIMINGS = pa.schema(
    [("scene_id", pa.string()), ("stage", pa.string()), ("cpu_s", pa.float64()), ("wall_s", pa.float64())]
)

TABLES = {"scenes": SCENES, "objects": OBJECTS, "tasks": TASKS, "trajectories": TRAJECTORIES}  # consumers query these
STORED_TABLES = {**TABLES, "timings": TIMINGS}


def normalize_row(row: Mapping[str, Any], schema: pa.Schema) -> dict[str, Any]:
    """Normalize a row: every column of its table in order, None for missing values, numbers of the column's type.

    What is written and read back then equals what was given. Columns that the table does not have stay, behind the
    others: the writer of the row refuses them.
    """
    known = {field.name: _convert(row.get(field.name), field.type) for field in schema}
    return {**known, **{name: value for name, value in row.items() if name not in known}}


def _convert(value: Any, kind: pa.DataType) -> Any:
    if pa.types.is_floating(kind) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return list(value) if isinstance(value, tuple) else value
