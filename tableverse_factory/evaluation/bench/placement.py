"""Errors of position, heading and size of placed objects in synthetic captures."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from schemas.config import Config
from schemas.geometry import Pose, TriangleMesh
from schemas.manifest import SceneKind
from schemas.objects import FitUncertainty, PerceivedObjects, PlacedObject, PlacedObjects
from schemas.observation import Observation
from schemas.outcome import Done
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.bench.captures import list_captures, make_row, make_scene_id
from tableverse_factory.evaluation.methods.heading import compute_heading_error, find_symmetric_turns
from tableverse_factory.evaluation.methods.sources import read_pose
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.transforms import (
    matrix_from_pose,
    pose_from_matrix,
    quaternion_about_z,
    rotation_matrix,
)
from tableverse_factory.geometry.mesh.meshes import box_center, place_mesh, read_mesh
from tableverse_factory.models.services import Services
from tableverse_factory.sources.discovery import GROUND_TRUTH_NAME
from tableverse_factory.stages.observe.observe import observe
from tableverse_factory.stages.perceive.perceive import perceive
from tableverse_factory.stages.place.place import place

MESHES = ("carved", "replay")
MASKS = ("replay", "geometric")


@dataclass(frozen=True, slots=True)
class PlacementError:
    """Errors of one true object of one capture; NaN if it was not placed."""

    scene: str  # name of the capture's folder
    label: str
    completion: str  # empty if the object was not placed
    visible_fraction: float  # of the object in the image
    symmetry: int  # headings at which the true mesh looks alike: 1 for none but its own, 0 for all (round)
    position_error_m: float = np.nan  # between the centres of the axis-aligned boxes in the true table frame
    height_error_m: float = np.nan  # signed, along z
    heading_error_rad: float = np.nan  # smallest turn about z onto the true mesh; NaN for a round one
    size_error: float = np.nan  # mean over the axes of the relative error of the sides of the boxes
    residual_m: float = np.nan  # median distance from the observed points to the placed mesh
    position_std_m: float = np.nan  # as `place` states it, like the next two; NaN without one
    heading_std_rad: float = np.nan
    ambiguity: float = np.nan


@dataclass(frozen=True, slots=True, eq=False)
class PlacedTruth:
    """A true object of `truth.json`, with its mesh in its own frame and in the true table frame (`standing`)."""

    instance_id: int
    label: str
    visible_fraction: float
    mesh: TriangleMesh
    standing: TriangleMesh
    symmetry: int


@dataclass(frozen=True, slots=True, eq=False)
class PlacementTruth:
    """True objects and camera pose of one capture."""

    objects: tuple[PlacedTruth, ...]
    camera_to_table: Pose


def bench_placement(
    folder: Path, config: Config, ways: tuple[tuple[str, str], ...]
) -> Iterator[dict[tuple[str, str], list[PlacementError]]]:
    """Run every capture with a `truth.json` in `folder`, or `folder` itself, up to `place`, for each pair of backends.

    A way is a pair of `perceive.detector` and `place.mesh_model`. For the mesh model `replay`, the true meshes are
    recorded at longest side 1 and at random headings, as an ideal MeshModel would return them.
    """
    captures = list_captures(folder, [GROUND_TRUTH_NAME])
    if not captures:
        raise InputError(f"{folder} holds no captures with a truth.json: make some with `tableverse synth`")
    for capture in captures:
        truth = read_placement_truth(capture)
        yield {way: compare_capture(capture, truth, _select_backends(config, *way)) for way in ways}


def _select_backends(config: Config, masks: str, meshes: str) -> Config:
    detecting = config.perceive.model_copy(update={"detector": masks})
    placing = config.place.model_copy(update={"mesh_model": meshes})
    return config.model_copy(update={"perceive": detecting, "place": placing})


def read_placement_truth(capture: Path) -> PlacementTruth:
    """Read the `truth.json` of a capture and its meshes."""
    truth = json.loads((capture / GROUND_TRUTH_NAME).read_text())
    return PlacementTruth(
        tuple(_read_true_object(capture, entry) for entry in truth["objects"]), read_pose(truth["camera_to_table"])
    )


def _read_true_object(capture: Path, entry: dict[str, Any]) -> PlacedTruth:
    mesh = read_mesh((capture / entry["mesh"]).read_bytes(), entry["mesh"])
    standing = place_mesh(mesh, read_pose(entry["pose"]))
    turns = find_symmetric_turns(standing)
    seen = float(entry["visible_fraction"])
    return PlacedTruth(entry["instance_id"], entry["label"], seen, mesh, standing, 0 if turns is None else len(turns))


def compare_capture(capture: Path, truth: PlacementTruth, config: Config) -> list[PlacementError]:
    """Compare the true objects of one capture with the placed ones."""
    found = place_capture(capture, truth, config)
    return [_compare_object(capture.name, item, truth, found) for item in truth.objects]


def place_capture(
    capture: Path, truth: PlacementTruth, config: Config
) -> tuple[PerceivedObjects, PlacedObjects] | None:
    """Return the perceived and the placed objects of a capture; None if a stage dropped it."""
    services, scene_id = Services(Path()), make_scene_id(capture)
    item = make_row(SceneKind.CAPTURE, capture, scene_id)
    observed = observe(item, config, make_rng(config.run.seed, scene_id, "observe"), services)
    if not isinstance(observed, Done):
        return None
    seen = _attach_true_meshes(observed.value, truth, config) if config.place.mesh_model == "replay" else observed.value
    perceived = perceive(seen, config, make_rng(config.run.seed, scene_id, "perceive"), services)
    if not isinstance(perceived, Done):
        return None
    placed = place(perceived.value, config, make_rng(config.run.seed, scene_id, "place"), services)
    return (perceived.value, placed.value) if isinstance(placed, Done) else None


def _attach_true_meshes(seen: Observation, truth: PlacementTruth, config: Config) -> Observation:
    """Record the true meshes without their heading, at longest side 1: a MeshModel does not know metres."""
    rng = make_rng(config.run.seed, seen.scene_id, "bench-turn")
    meshes = []
    for item in truth.objects:
        turn = rotation_matrix(quaternion_about_z(rng.uniform(-np.pi, np.pi)))
        vertices = (item.mesh.vertices - box_center(item.mesh)) @ turn.T
        vertices *= 1.0 / np.ptp(item.mesh.vertices, axis=0).max()
        meshes.append((item.instance_id, TriangleMesh(vertices, item.mesh.faces)))
    return replace(seen, recorded_meshes=tuple(meshes))


def _compare_object(
    scene: str, item: PlacedTruth, truth: PlacementTruth, found: tuple[PerceivedObjects, PlacedObjects] | None
) -> PlacementError:
    ours = None if found is None else _find_placed(found[0], found[1], item.instance_id)
    if found is None or ours is None:
        return PlacementError(scene, item.label, "", item.visible_fraction, item.symmetry)
    camera_to_table = matrix_from_pose(found[0].camera_to_table)  # estimated; both frames share the camera
    to_truth = matrix_from_pose(truth.camera_to_table) @ np.linalg.inv(camera_to_table)
    standing = place_mesh(place_mesh(ours.mesh, ours.pose, ours.scale), pose_from_matrix(to_truth))
    our_box, true_box = np.stack(aabb(standing.vertices)), np.stack(aabb(item.standing.vertices))
    shift = our_box.mean(axis=0) - true_box.mean(axis=0)
    sizes = np.ptp(our_box, axis=0) / np.ptp(true_box, axis=0)
    heading = compute_heading_error(standing, item.standing) if item.symmetry else None
    stated = ours.uncertainty or FitUncertainty(np.nan, None, 1, np.nan)
    return PlacementError(
        scene=scene,
        label=item.label,
        completion=ours.completion,
        visible_fraction=item.visible_fraction,
        symmetry=item.symmetry,
        position_error_m=float(np.linalg.norm(shift)),
        height_error_m=float(shift[2]),
        heading_error_rad=np.nan if heading is None else heading,
        size_error=float(np.abs(sizes - 1.0).mean()),
        residual_m=ours.fit_residual_m,
        position_std_m=stated.position_std_m,
        heading_std_rad=np.nan if stated.heading_std_rad is None else stated.heading_std_rad,
        ambiguity=stated.ambiguity,
    )


def _find_placed(perceived: PerceivedObjects, placed: PlacedObjects, instance_id: int) -> PlacedObject | None:
    """Find the placed object with most pixels of the true instance among those that mostly show it."""
    recorded = perceived.observation.recorded_ids
    if recorded is None or placed.evidence is None:
        return None
    best, most = None, 0
    for item, pixel in zip(placed.objects, placed.evidence.object_pixels, strict=True):
        values, counts = np.unique(recorded[perceived.instance_ids == pixel], return_counts=True)
        own = int(counts[values == instance_id].sum())
        if own > most and own == counts.max():
            best, most = item, own
    return best
