"""Where, how turned and how large `place` puts the objects of synthetic captures, against the truth beside each."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from schemas.config import Config
from schemas.geometry import Matrix4, Points, Pose, TriangleMesh
from schemas.manifest import ImageRow, SceneKind
from schemas.objects import FitUncertainty, PerceivedObjects, PlacedObject, PlacedObjects
from schemas.observation import Observation
from schemas.outcome import Done
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.seeding import rng_for
from tableverse_factory.evaluation.methods.heading import heading_error, symmetric_turns
from tableverse_factory.geometry.math.transforms import (
    matrix_from_pose,
    normalized_quaternion,
    pose_from_matrix,
    quaternion_about_z,
    rotation_matrix,
)
from tableverse_factory.geometry.mesh.meshes import box_center, placed_mesh, read_mesh
from tableverse_factory.models.services import Services
from tableverse_factory.stages.observe.observe import observe
from tableverse_factory.stages.perceive.perceive import perceive
from tableverse_factory.stages.place.place import place

MESHES = ("carved", "replay")
MASKS = ("replay", "geometric")
UNIT = 1.0
"""Longest side of a true mesh as `replay` gets it: a MeshModel knows no metres."""


@dataclass(frozen=True, slots=True)
class PlacementError:
    """One true object of one capture.

    Attributes:
        scene: Name of the capture's folder.
        label: True label.
        completion: How it was completed; empty where it was not placed.
        visible_fraction: Part of it that the picture shows.
        symmetry: How many headings look alike on the true mesh as it stands: 1 none but its own, 0 all (round).
        position_error_m: Distance between the centres of the axis-aligned boxes, in the true table frame; NaN where
            it was not placed.
        height_error_m: The same along z alone, signed.
        heading_error_rad: Smallest turn about the vertical that brings it onto the true one, NaN for a round one.
        size_error: Mean over the axes of the relative error of those boxes' sides.
        residual_m: Median distance from the observed points to the placed mesh.
        position_std_m: As `place` states it; NaN where it does not.
        heading_std_rad: As `place` states it; NaN where it does not.
        ambiguity: As `place` states it; NaN where it does not.
    """

    scene: str
    label: str
    completion: str
    visible_fraction: float
    symmetry: int
    position_error_m: float = np.nan
    height_error_m: float = np.nan
    heading_error_rad: float = np.nan
    size_error: float = np.nan
    residual_m: float = np.nan
    position_std_m: float = np.nan
    heading_std_rad: float = np.nan
    ambiguity: float = np.nan


@dataclass(frozen=True, slots=True, eq=False)
class PlacedTruth:
    """What `truth.json` says of one object: its mesh in its own frame, and standing in the true table frame."""

    instance_id: int
    label: str
    visible_fraction: float
    mesh: TriangleMesh
    standing: TriangleMesh
    symmetry: int


@dataclass(frozen=True, slots=True, eq=False)
class PlacementTruth:
    """The true objects of one capture, and where its camera stood."""

    objects: tuple[PlacedTruth, ...]
    camera_to_table: Pose


def bench_placement(
    folder: Path, config: Config, ways: tuple[tuple[str, str], ...]
) -> Iterator[dict[tuple[str, str], list[PlacementError]]]:
    """Runs every capture with a `truth.json` in `folder` up to `place`, once for each way.

    Args:
        folder: Of captures, as `tableverse synth` makes them.
        config: But for the detector and the mesh model.
        ways: Pairs of `perceive.detector` and `place.mesh_model`. For `replay` meshes, the true ones are recorded
            with their longest side 1 and turned about the vertical by chance: what a MeshModel would give at best.

    Raises:
        InputError: if no capture there has a truth.
    """
    captures = [path.parent for path in sorted(folder.glob("*/truth.json"))]
    if not captures:
        raise InputError(f"{folder} holds no captures with a truth.json: make some with `tableverse synth`")
    for capture in captures:
        truth = read_truth(capture)
        yield {way: compare_capture(capture, truth, _with(config, *way)) for way in ways}


def _with(config: Config, masks: str, meshes: str) -> Config:
    return config.model_copy(
        update={
            "perceive": config.perceive.model_copy(update={"detector": masks}),
            "place": config.place.model_copy(update={"mesh_model": meshes}),
        }
    )


def read_truth(capture: Path) -> PlacementTruth:
    """The content of a capture's `truth.json` and of the meshes beside it."""
    truth = json.loads((capture / "truth.json").read_text())
    return PlacementTruth(
        tuple(_true_object(capture, entry) for entry in truth["objects"]), _pose(truth["camera_to_table"])
    )


def _true_object(capture: Path, entry: dict[str, Any]) -> PlacedTruth:
    mesh = read_mesh((capture / entry["mesh"]).read_bytes(), entry["mesh"])
    standing = placed_mesh(mesh, _pose(entry["pose"]))
    turns = symmetric_turns(standing)
    seen = float(entry["visible_fraction"])
    return PlacedTruth(entry["instance_id"], entry["label"], seen, mesh, standing, 0 if turns is None else len(turns))


def compare_capture(capture: Path, truth: PlacementTruth, config: Config) -> list[PlacementError]:
    """The true objects of one capture, each with what became of it."""
    found = run_to_place(capture, truth, config)
    return [_compared(capture.name, item, truth, found) for item in truth.objects]


def run_to_place(capture: Path, truth: PlacementTruth, config: Config) -> tuple[PerceivedObjects, PlacedObjects] | None:
    """The perceived and the placed objects of a capture; None where a stage dropped it."""
    services = Services(Path())
    item = ImageRow(scene_id=capture.name, kind=SceneKind.CAPTURE, uri=str(capture))
    observed = observe(item, config, rng_for(config.run.seed, capture.name, "observe"), services)
    if not isinstance(observed, Done):
        return None
    seen = _recorded(observed.value, truth, config) if config.place.mesh_model == "replay" else observed.value
    perceived = perceive(seen, config, rng_for(config.run.seed, capture.name, "perceive"), services)
    if not isinstance(perceived, Done):
        return None
    placed = place(perceived.value, config, rng_for(config.run.seed, capture.name, "place"), services)
    return (perceived.value, placed.value) if isinstance(placed, Done) else None


def _recorded(seen: Observation, truth: PlacementTruth, config: Config) -> Observation:
    """The observation with the true meshes for recorded ones, without their size and heading."""
    rng = rng_for(config.run.seed, seen.scene_id, "bench-turn")
    meshes = []
    for item in truth.objects:
        turn = rotation_matrix(quaternion_about_z(rng.uniform(-np.pi, np.pi)))
        vertices = (item.mesh.vertices - box_center(item.mesh)) @ turn.T
        vertices *= UNIT / np.ptp(item.mesh.vertices, axis=0).max()
        meshes.append((item.instance_id, TriangleMesh(vertices, item.mesh.faces)))
    return replace(seen, recorded_meshes=tuple(meshes))


def _compared(
    scene: str, item: PlacedTruth, truth: PlacementTruth, found: tuple[PerceivedObjects, PlacedObjects] | None
) -> PlacementError:
    ours = None if found is None else _match(found[0], found[1], item.instance_id)
    if found is None or ours is None:
        return PlacementError(scene, item.label, "", item.visible_fraction, item.symmetry)
    to_truth = pose_from_matrix(_between(found[0].camera_to_table, truth.camera_to_table))
    standing = placed_mesh(placed_mesh(ours.mesh, ours.pose, ours.scale), to_truth)
    our_box, true_box = _box(standing.vertices), _box(item.standing.vertices)
    shift = our_box.mean(axis=0) - true_box.mean(axis=0)
    sizes = np.ptp(our_box, axis=0) / np.ptp(true_box, axis=0)
    heading = heading_error(standing, item.standing) if item.symmetry else None
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


def _match(perceived: PerceivedObjects, placed: PlacedObjects, instance_id: int) -> PlacedObject | None:
    """The placed object whose pixels are mostly those of the true instance; of several the one with most of them."""
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


def _between(ours: Pose, true: Pose) -> Matrix4:
    """From our table frame to the true one, through the camera that both know."""
    motion: Matrix4 = matrix_from_pose(true) @ np.linalg.inv(matrix_from_pose(ours))
    return motion


def _pose(value: dict[str, Any]) -> Pose:
    quaternion = normalized_quaternion(np.array(value["quaternion_wxyz"], dtype=np.float64))
    return Pose(np.array(value["position"], dtype=np.float64), quaternion)


def _box(points: Points) -> Float64[np.ndarray, "2 3"]:
    """Lowest and highest corner."""
    return np.stack([points.min(axis=0), points.max(axis=0)])
