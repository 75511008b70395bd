"""Comparison of methods that remove collisions from layouts: collisions left, rest, displacement, relations, cost.

It extends table 2 of the paper.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from schemas.config import Config
from schemas.geometry import Pose, Vector3
from schemas.objects import PlacedObject
from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.bench.free_simulation import BURST_SPEED, is_stable, measure_burst_speed
from tableverse_factory.evaluation.bench.layouts import LayoutCase, read_case
from tableverse_factory.evaluation.bench.rectifiers import DEFAULT_METHODS, RECTIFICATION_METHODS, MethodResult
from tableverse_factory.evaluation.bench.support_by_force import TrueSupport, find_support_by_force, find_true_support
from tableverse_factory.evaluation.methods.layout import compute_percent
from tableverse_factory.geometry.collision.penetration import measure_mesh_penetrations, measure_piece_penetrations
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.geometry.mesh.meshes import box_center
from tableverse_factory.geometry.relations.preserved import PreservedRelations, compare_relations, find_relations


@dataclass(slots=True)
class LayoutScore:
    """Scores of one method over all layouts; lists are by scene or by object."""

    piece_depths_m: list[float] = field(default_factory=list)  # deepest overlap of pieces in each scene [m]
    mesh_depths_m: list[float] = field(default_factory=list)  # the same on the meshes [m]
    resting: list[bool] = field(default_factory=list)  # whether each scene is stable
    from_observed_m: list[float] = field(default_factory=list)  # shift of the box centre from the layout [m]
    from_truth_m: list[float] = field(default_factory=list)  # the same from the true pose, where known [m]
    kept: PreservedRelations = field(default_factory=PreservedRelations)  # true relations that still hold
    by_force: int = 0  # true supports by force, where a method has simulated
    by_force_kept: int = 0  # of them, those that still hold
    by_force_left_out: int = 0  # further pairs of which one moved too far until the truth rested
    by_force_unknown: int = 0  # scenes whose true support by force is not known
    azimuth_changes_rad: list[float] = field(default_factory=list)  # of each group about the root [rad]
    burst_speeds: list[float] = field(default_factory=list)  # largest in each scene just after its release [m/s]
    fallen: int = 0  # objects that are no longer on the table
    left_out: int = 0  # objects, copies included, that did not fit into their container
    seconds: list[float] = field(default_factory=list)  # CPU time of each scene, without decomposition [s]


def bench_lccr(
    paths: Sequence[Path],
    truth: Path | None,
    config: Config,
    cache_dir: Path,
    methods: Sequence[str] = DEFAULT_METHODS,
    on_layout: Callable[[LayoutCase, Mapping[str, MethodResult]], object] = lambda *_: None,
) -> dict[str, LayoutScore]:
    """Score methods (keys of `RECTIFICATION_METHODS`) on layouts, one after the other, against `read_case`'s truth."""
    if unknown := [name for name in methods if name not in RECTIFICATION_METHODS]:
        raise InputError(f"unknown method {unknown[0]!r}: choose from {', '.join(RECTIFICATION_METHODS)}")
    scores = {name: LayoutScore() for name in methods}
    for path in paths:
        case = read_case(path, truth, config, cache_dir)
        results = {name: RECTIFICATION_METHODS[name](case, config) for name in methods}
        simulated = any(result.simulated for result in results.values())
        support = find_true_support(case, config.settle) if simulated else None
        for name, result in results.items():
            _add_result(scores[name], case, result, config.settle.timestep_s)
            if result.simulated:
                _add_support(scores[name], case, result, support, config.settle.timestep_s)
        on_layout(case, results)
    return scores


def summarize_scores(score: LayoutScore, epsilons_m: Sequence[float]) -> dict[str, float | None]:
    """Summarize the scores of one method by row of the table; None where nothing was measured.

    Each of `epsilons_m`, depths beyond which two objects collide, has rows of its own [m].
    """
    azimuths_known = np.abs([angle for angle in score.azimuth_changes_rad if np.isfinite(angle)])
    return {
        "scenes": len(score.seconds),
        "objects": len(score.from_observed_m),
        **{
            f"colliding by > {epsilon * 1e3:g} mm, {on} [%]": _percent_true([depth > epsilon for depth in depths])
            for epsilon in epsilons_m
            for on, depths in (("pieces", score.piece_depths_m), ("meshes", score.mesh_depths_m))
        },
        "scenes at rest [%]": _percent_true(score.resting),
        "from observed, median [mm]": _percentile(score.from_observed_m, 50.0, 1e3),
        "from observed, p90 [mm]": _percentile(score.from_observed_m, 90.0, 1e3),
        "from truth, median [mm]": _percentile(score.from_truth_m, 50.0, 1e3),
        "from truth, p90 [mm]": _percentile(score.from_truth_m, 90.0, 1e3),
        "true relations": score.kept.carried + score.kept.contained,
        "support kept [%]": compute_percent(score.kept.carried_kept, score.kept.carried),
        "pairs by force": score.by_force,
        "pairs by force, left out": score.by_force_left_out,
        "scenes not known by force": score.by_force_unknown,
        "support kept, by force [%]": compute_percent(score.by_force_kept, score.by_force),
        "containment kept [%]": compute_percent(score.kept.contained_kept, score.kept.contained),
        "azimuth change, p90 [°]": _percentile(azimuths_known, 90.0, 180.0 / np.pi),
        "azimuth change, largest [°]": _percentile(azimuths_known, 100.0, 180.0 / np.pi),
        "first 0.1 s: speed, median [m/s]": _percentile(score.burst_speeds, 50.0, 1.0),
        "first 0.1 s: speed, p90 [m/s]": _percentile(score.burst_speeds, 90.0, 1.0),
        "bursting scenes [%]": _percent_true([speed > BURST_SPEED for speed in score.burst_speeds]),
        "objects off the table": score.fallen,
        "objects left out": score.left_out,
        "CPU a scene, median [ms]": _percentile(score.seconds, 50.0, 1e3),
        "CPU a scene, p90 [ms]": _percentile(score.seconds, 90.0, 1e3),
    }


def _percent_true(values: Sequence[bool]) -> float | None:
    return compute_percent(sum(values), len(values))


def _percentile(values: Sequence[float] | np.ndarray, percent: float, unit: float) -> float | None:
    return unit * float(np.percentile(values, percent)) if len(values) else None


def _add_result(score: LayoutScore, case: LayoutCase, result: MethodResult, timestep_s: float) -> None:
    objects, pieces, poses = result.layout.placed.objects, result.layout.pieces, result.scene.poses
    scales = [placed.scale for placed in objects]
    score.piece_depths_m.append(_find_deepest(measure_piece_penetrations(pieces, poses, scales)))
    score.mesh_depths_m.append(
        _find_deepest(measure_mesh_penetrations([placed.mesh for placed in objects], poses, scales))
    )
    score.resting.append(not result.restless and is_stable(result.scene, timestep_s))
    score.burst_speeds.append(measure_burst_speed(result.scene, timestep_s))
    score.fallen += len(result.scene.fallen)
    score.left_out += sum(placed.count for placed in case.item.objects) - len(objects)
    score.seconds.append(result.seconds)
    _add_observed(score, case, result)


def _add_observed(score: LayoutScore, case: LayoutCase, result: MethodResult) -> None:
    """Compare observed objects with the layout and the truth; copies added by `count` were never observed."""
    seen = [k for k, placed in enumerate(result.layout.placed.objects) if placed.copy_of is None]
    objects, pieces = [result.layout.placed.objects[k] for k in seen], [result.layout.pieces[k] for k in seen]
    poses, scales = [result.scene.poses[k] for k in seen], [placed.scale for placed in objects]
    ids = [placed.object_id for placed in objects]
    score.azimuth_changes_rad += case.azimuth_changes(dict(zip(ids, poses, strict=True))).tolist()
    if case.relations is not None:
        number = {placed.object_id: index for index, placed in enumerate(case.item.objects)}
        result_relations = find_relations(objects, pieces, poses, scales)
        score.kept += compare_relations(case.relations, result_relations.renumbered([number[name] for name in ids]))
    for placed, pose in zip(objects, poses, strict=True):
        center = _compute_center(placed, pose, placed.scale)
        score.from_observed_m.append(float(np.linalg.norm(center - _compute_center(placed, placed.pose, placed.scale))))
        if placed.object_id in case.truth:
            score.from_truth_m.append(
                float(np.linalg.norm(center - _compute_center(placed, *case.truth[placed.object_id])))
            )


def _add_support(
    score: LayoutScore, case: LayoutCase, result: MethodResult, truth: TrueSupport | None, timestep_s: float
) -> None:
    """Compare support by force with the truth; objects that were left out carry nothing."""
    if truth is None:
        score.by_force_unknown += 1
        return
    number = {placed.object_id: index for index, placed in enumerate(case.item.objects)}
    ids = [placed.copy_of or placed.object_id for placed in result.layout.placed.objects]
    found = {(number[ids[i]], number[ids[j]]) for i, j in find_support_by_force(result.scene, timestep_s)}
    score.by_force += len(truth.pairs)
    score.by_force_kept += len(truth.pairs & found)
    score.by_force_left_out += truth.left_out


def _find_deepest(depths: Sequence[tuple[int, int, float]]) -> float:
    return max((depth for _, _, depth in depths), default=0.0)


def _compute_center(placed: PlacedObject, pose: Pose, scale: float) -> Vector3:
    """Compute the centre of the box of the mesh in the table frame [m]."""
    return transform_points(pose, box_center(placed.mesh)[None], scale)[0]
