"""Where and how large `place` puts the objects of synthetic captures, against the truth beside each capture."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from schemas.config import Config
from schemas.geometry import Matrix4, Points, Pose
from schemas.manifest import ImageRow, SceneKind
from schemas.objects import PerceivedObjects, PlacedObject, PlacedObjects
from schemas.outcome import Done
from tableverse_factory.errors import InputError
from tableverse_factory.geometry.meshes import read_mesh
from tableverse_factory.geometry.transforms import (
    matrix_from_pose,
    normalized_quaternion,
    pose_from_matrix,
    transform_points,
)
from tableverse_factory.observe import observe
from tableverse_factory.perceive.perceive import perceive
from tableverse_factory.place.place import place
from tableverse_factory.seeding import rng_for
from tableverse_factory.services import Services


@dataclass(frozen=True, slots=True)
class Placement:
    """One true object of one capture.

    Attributes:
        scene: Name of the capture's folder.
        label: True label.
        completion: How it was completed; empty where it was not placed.
        visible_fraction: Part of it that the picture shows.
        position_error_m: Distance between the centres of the axis-aligned boxes, in the true table frame; NaN where
            it was not placed.
        height_error_m: The same along z alone, signed.
        size_error: Mean over the axes of the relative error of those boxes' sides.
    """

    scene: str
    label: str
    completion: str
    visible_fraction: float
    position_error_m: float
    height_error_m: float
    size_error: float


def bench_placement(folder: Path, config: Config | None = None) -> list[Placement]:
    """Runs every capture with a `truth.json` in `folder` up to `place` and compares each of its true objects.

    Raises:
        InputError: if no capture there has a truth.
    """
    captures = [path.parent for path in sorted(folder.glob("*/truth.json"))]
    if not captures:
        raise InputError(f"{folder} holds no captures with a truth.json: make some with `tableverse synth`")
    return [entry for capture in captures for entry in compare_capture(capture, config or Config())]


def compare_capture(capture: Path, config: Config) -> Iterator[Placement]:
    """The true objects of one capture, each with what became of it."""
    truth = json.loads((capture / "truth.json").read_text())
    found = run_to_place(capture, config)
    for entry in truth["objects"]:
        yield _compared(capture, entry, truth, found)


def run_to_place(capture: Path, config: Config) -> tuple[PerceivedObjects, PlacedObjects] | None:
    """The perceived and the placed objects of a capture; None where a stage dropped it."""
    services = Services(Path())
    item = ImageRow(scene_id=capture.name, kind=SceneKind.CAPTURE, uri=str(capture))
    observed = observe(item, config, rng_for(config.run.seed, capture.name, "observe"), services)
    if not isinstance(observed, Done):
        return None
    perceived = perceive(observed.value, config, rng_for(config.run.seed, capture.name, "perceive"), services)
    if not isinstance(perceived, Done):
        return None
    placed = place(perceived.value, config, rng_for(config.run.seed, capture.name, "place"), services)
    return (perceived.value, placed.value) if isinstance(placed, Done) else None


def _compared(
    capture: Path, entry: dict[str, Any], truth: dict[str, Any], found: tuple[PerceivedObjects, PlacedObjects] | None
) -> Placement:
    ours = None if found is None else _match(found[0], found[1], entry["instance_id"])
    seen = float(entry["visible_fraction"])
    if found is None or ours is None:
        return Placement(capture.name, entry["label"], "", seen, np.nan, np.nan, np.nan)
    mesh = read_mesh((capture / entry["mesh"]).read_bytes(), entry["mesh"])
    true_box = _box(transform_points(_pose(entry["pose"]), mesh.vertices))
    to_truth = _between(found[0].camera_to_table, _pose(truth["camera_to_table"]))
    standing = transform_points(ours.pose, ours.mesh.vertices, ours.scale)
    our_box = _box(transform_points(pose_from_matrix(to_truth), standing))
    shift = our_box.mean(axis=0) - true_box.mean(axis=0)
    sizes = np.ptp(our_box, axis=0) / np.ptp(true_box, axis=0)
    return Placement(
        scene=capture.name,
        label=entry["label"],
        completion=ours.completion,
        visible_fraction=seen,
        position_error_m=float(np.linalg.norm(shift)),
        height_error_m=float(shift[2]),
        size_error=float(np.abs(sizes - 1.0).mean()),
    )


def _match(perceived: PerceivedObjects, placed: PlacedObjects, instance_id: int) -> PlacedObject | None:
    """The placed object whose pixels are mostly those of the true instance."""
    recorded = perceived.observation.recorded_ids
    if recorded is None or placed.evidence is None:
        return None
    for item, pixel in zip(placed.objects, placed.evidence.object_pixels, strict=True):
        values, counts = np.unique(recorded[perceived.instance_ids == pixel], return_counts=True)
        if len(values) and int(values[np.argmax(counts)]) == instance_id:
            return item
    return None


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
