"""The paper's table 2 on any folder of layouts: collisions before and after LCCR, and what it cost to remove them."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter, ValidationError

from schemas.config import Config, RectifyConfig
from schemas.geometry import ConvexPieces, Pose, Vector3
from schemas.layout import LayoutPose
from schemas.manifest import ImageRow, SceneKind
from schemas.objects import PlacedObject, PlacedObjects
from schemas.outcome import Done
from tableverse_factory.errors import InputError
from tableverse_factory.geometry.convex import decompose
from tableverse_factory.geometry.meshes import box_center
from tableverse_factory.geometry.penetration import mesh_penetrations, piece_penetrations
from tableverse_factory.geometry.transforms import normalized_quaternion, transform_points, translated
from tableverse_factory.observe import read_layout
from tableverse_factory.rectify.lccr import lccr
from tableverse_factory.rectify.parts import part_of
from tableverse_factory.rectify.radial import azimuths
from tableverse_factory.seeding import rng_for
from tableverse_factory.services import Services

Truth = dict[str, tuple[Pose, float]]
"""Pose and scale of each object at which it truly rests."""


@dataclass(slots=True)
class Score:
    """One method over all layouts.

    Attributes:
        scenes: How many there were.
        colliding_pieces: How many collide on the convex pieces.
        colliding_meshes: How many collide on the meshes.
        from_observed_m: Displacement of each object's box centre from the layout [m].
        from_truth_m: The same from the truth, where there is one [m].
        azimuth_change_rad: Of each group about the root.
        seconds: CPU time of each scene, without decomposition [s].
    """

    scenes: int = 0
    colliding_pieces: int = 0
    colliding_meshes: int = 0
    from_observed_m: list[float] = field(default_factory=list)
    from_truth_m: list[float] = field(default_factory=list)
    azimuth_change_rad: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class _Result:
    poses: tuple[Pose, ...]
    azimuth_change_rad: float
    seconds: float


class _Rest(LayoutPose):
    scale: float = 1.0


_TRUTH = TypeAdapter(dict[str, _Rest])

Method = Callable[[Sequence[PlacedObject], Sequence[ConvexPieces], RectifyConfig], _Result]


def bench_lccr(folder: Path, truth: Path | None, epsilon_m: float, config: Config, cache_dir: Path) -> dict[str, Score]:
    """Scores of every method of `METHODS` over the layouts of a folder.

    Args:
        folder: Holds layout files, `*.json`.
        truth: Holds files of the same names: object id to position, quaternion_wxyz, scale.
        epsilon_m: Overlaps up to this depth are no collision [m].
        config: Of the run.
        cache_dir: Where convex pieces are kept.

    Raises:
        InputError: if the folder holds no layout, or a layout or its truth cannot be read.
    """
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise InputError(f"{folder} holds no layout: give a folder of *.json files", "no_layouts")
    scores = {name: Score() for name in METHODS}
    for path in paths:
        item = _read(path, config)
        pieces = [decompose(placed.mesh, config.rectify, cache_dir) for placed in item.objects]
        rests = _read_truth(truth / path.name) if truth else {}
        for name, method in METHODS.items():
            _score(scores[name], method, item, pieces, rests, epsilon_m, config.rectify)
    return scores


def summary(score: Score) -> dict[str, float | None]:
    """What the table shows, by the names of its rows; None where there is nothing to measure."""
    percent = 100.0 / max(score.scenes, 1)
    azimuths_known = [angle for angle in score.azimuth_change_rad if np.isfinite(angle)]
    return {
        "scenes": score.scenes,
        "objects": len(score.from_observed_m),
        "colliding on pieces [%]": percent * score.colliding_pieces,
        "colliding on meshes [%]": percent * score.colliding_meshes,
        "from observed, median [mm]": _percentile(score.from_observed_m, 50.0, 1e3),
        "from observed, p90 [mm]": _percentile(score.from_observed_m, 90.0, 1e3),
        "from truth, median [mm]": _percentile(score.from_truth_m, 50.0, 1e3),
        "from truth, p90 [mm]": _percentile(score.from_truth_m, 90.0, 1e3),
        "azimuth change, largest [rad]": max(azimuths_known, default=None),
        "CPU a scene, median [ms]": _percentile(score.seconds, 50.0, 1e3),
        "CPU a scene, p90 [ms]": _percentile(score.seconds, 90.0, 1e3),
    }


def _percentile(values: Sequence[float], percent: float, unit: float) -> float | None:
    return unit * float(np.percentile(values, percent)) if values else None


def _score(
    score: Score,
    method: Method,
    item: PlacedObjects,
    pieces: Sequence[ConvexPieces],
    rests: Truth,
    epsilon_m: float,
    config: RectifyConfig,
) -> None:
    result = method(item.objects, pieces, config)
    score.seconds.append(result.seconds)
    scales = [placed.scale for placed in item.objects]
    meshes = [placed.mesh for placed in item.objects]
    score.scenes += 1
    score.colliding_pieces += _deepest(piece_penetrations(pieces, result.poses, scales)) > epsilon_m
    score.colliding_meshes += _deepest(mesh_penetrations(meshes, result.poses, scales)) > epsilon_m
    score.azimuth_change_rad.append(result.azimuth_change_rad)
    for placed, pose in zip(item.objects, result.poses, strict=True):
        center = _center(placed, pose, placed.scale)
        score.from_observed_m.append(float(np.linalg.norm(center - _center(placed, placed.pose, placed.scale))))
        if placed.object_id in rests:
            score.from_truth_m.append(float(np.linalg.norm(center - _center(placed, *rests[placed.object_id]))))


def _direct(objects: Sequence[PlacedObject], pieces: Sequence[ConvexPieces], config: RectifyConfig) -> _Result:  # noqa: ARG001
    return _Result(tuple(placed.pose for placed in objects), 0.0, 0.0)


def _lccr(objects: Sequence[PlacedObject], pieces: Sequence[ConvexPieces], config: RectifyConfig) -> _Result:
    start = time.process_time()
    parts = [part_of(placed, its) for placed, its in zip(objects, pieces, strict=True)]
    rectified = lccr(parts, config)
    seconds = time.process_time() - start
    before = azimuths(parts, rectified.groups)
    after = azimuths(rectified.parts, rectified.groups)
    change = (after - before + np.pi) % (2 * np.pi) - np.pi
    poses = tuple(
        translated(placed.pose, part.body.offset) for placed, part in zip(objects, rectified.parts, strict=True)
    )
    return _Result(poses, float(np.nanmax(np.abs(change), initial=0.0)), seconds)


METHODS: dict[str, Method] = {"Direct": _direct, "LCCR": _lccr}


def _deepest(depths: Sequence[tuple[int, int, float]]) -> float:
    return max((depth for _, _, depth in depths), default=0.0)


def _center(placed: PlacedObject, pose: Pose, scale: float) -> Vector3:
    """Where the centre of the mesh's own box stands in the table frame [m]."""
    center: Vector3 = transform_points(pose, box_center(placed.mesh)[None], scale)[0]
    return center


def _read(path: Path, config: Config) -> PlacedObjects:
    row = ImageRow(scene_id="bench", kind=SceneKind.LAYOUT, uri=str(path))
    outcome = read_layout(row, config, rng_for(0, path.stem, "bench"), Services(Path()))
    if not isinstance(outcome, Done):
        raise InputError(f"{path.name}: {outcome}", "bad_layout")
    return outcome.value


def _read_truth(path: Path) -> Truth:
    try:
        rests = _TRUTH.validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"truth {path.name}: {where}: {first['msg']}", "bad_truth") from error
    return {
        name: (Pose(np.array(rest.position), normalized_quaternion(np.array(rest.quaternion_wxyz))), rest.scale)
        for name, rest in rests.items()
    }
