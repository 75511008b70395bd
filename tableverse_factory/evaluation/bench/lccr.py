"""The paper's table 2 on any folder of layouts, and more: what each way of removing collisions leaves and costs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from schemas.config import Config
from schemas.geometry import Pose, Vector3
from schemas.objects import PlacedObject
from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.bench.layouts import Case, read_case
from tableverse_factory.evaluation.bench.rectifiers import METHODS, USUAL, Result
from tableverse_factory.evaluation.bench.release import BURST_SPEED, burst_speed, stays
from tableverse_factory.evaluation.bench.support_by_force import TrueCarrying, carried_by_force, truly_carried
from tableverse_factory.geometry.collision.penetration import mesh_penetrations, piece_penetrations
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.geometry.mesh.meshes import box_center
from tableverse_factory.geometry.relations.preserved import PreservedRelations, compare_relations, relations_of


@dataclass(slots=True)
class LayoutScore:
    """One method over all layouts; lists are by scene or by object.

    Attributes:
        piece_depths_m: Deepest overlap of two objects' convex pieces in each scene [m].
        mesh_depths_m: The same on the meshes [m].
        resting: Whether each scene stays as it is.
        from_observed_m: Displacement of the box centre of each object that was seen from the layout [m].
        from_truth_m: The same from the truth, where there is one [m].
        kept: Relations of the truth that hold, by how things touch.
        borne: How many pairs of the truth carry one another by force, where a method has simulated.
        borne_kept: How many of them still do.
        borne_left_out: How many more pairs do so in the truth, but only after one of them moved too far to be believed.
        borne_unknown: Scenes whose truth is not known by force: none is given, or it does not come to rest.
        azimuth_changes_rad: Of each group about the root, as it was observed.
        burst_speeds: Largest speed in each scene just after it is let go [m/s].
        fallen: How many objects are no longer on the table.
        left_out: How many things, counted ones included, did not fit into their container.
        seconds: CPU time of each scene, without decomposition [s].
    """

    piece_depths_m: list[float] = field(default_factory=list)
    mesh_depths_m: list[float] = field(default_factory=list)
    resting: list[bool] = field(default_factory=list)
    from_observed_m: list[float] = field(default_factory=list)
    from_truth_m: list[float] = field(default_factory=list)
    kept: PreservedRelations = field(default_factory=PreservedRelations)
    borne: int = 0
    borne_kept: int = 0
    borne_left_out: int = 0
    borne_unknown: int = 0
    azimuth_changes_rad: list[float] = field(default_factory=list)
    burst_speeds: list[float] = field(default_factory=list)
    fallen: int = 0
    left_out: int = 0
    seconds: list[float] = field(default_factory=list)


def bench_lccr(
    paths: Sequence[Path],
    truth: Path | None,
    config: Config,
    cache_dir: Path,
    methods: Sequence[str] = USUAL,
    on_layout: Callable[[Case, Mapping[str, Result]], None] | None = None,
) -> dict[str, LayoutScore]:
    """Scores of methods over layouts, one layout after the other.

    Args:
        paths: Layout files.
        truth: Holds files of the same names: object id to position, quaternion_wxyz, scale.
        config: Of the run.
        cache_dir: Where convex pieces are kept.
        methods: Keys of `METHODS`.
        on_layout: Called after each layout with what came out.

    Raises:
        InputError: if a method is unknown, or a layout or its truth cannot be read.
    """
    if unknown := [name for name in methods if name not in METHODS]:
        raise InputError(f"unknown method {unknown[0]!r}: give some of {', '.join(METHODS)}")
    scores = {name: LayoutScore() for name in methods}
    for path in paths:
        case = read_case(path, truth, config, cache_dir)
        results = {name: METHODS[name](case, config) for name in methods}
        borne = truly_carried(case, config.settle) if any(result.simulated for result in results.values()) else None
        for name, result in results.items():
            _add(scores[name], case, result, config.settle.timestep_s)
            if result.simulated:
                _add_borne(scores[name], case, result, borne, config.settle.timestep_s)
        if on_layout is not None:
            on_layout(case, results)
    return scores


def summary(score: LayoutScore, epsilons_m: Sequence[float]) -> dict[str, float | None]:
    """What the table shows, by the names of its rows; None where there is nothing to measure.

    Args:
        score: Of one method.
        epsilons_m: A scene collides where two objects overlap by more than this [m]; rows for each.
    """
    azimuths_known = np.abs([angle for angle in score.azimuth_changes_rad if np.isfinite(angle)])
    return {
        "scenes": len(score.seconds),
        "objects": len(score.from_observed_m),
        **{
            f"colliding by > {epsilon * 1e3:g} mm, {on} [%]": _share([depth > epsilon for depth in depths])
            for epsilon in epsilons_m
            for on, depths in (("pieces", score.piece_depths_m), ("meshes", score.mesh_depths_m))
        },
        "scenes at rest [%]": _share(score.resting),
        "from observed, median [mm]": _percentile(score.from_observed_m, 50.0, 1e3),
        "from observed, p90 [mm]": _percentile(score.from_observed_m, 90.0, 1e3),
        "from truth, median [mm]": _percentile(score.from_truth_m, 50.0, 1e3),
        "from truth, p90 [mm]": _percentile(score.from_truth_m, 90.0, 1e3),
        "true relations": score.kept.carried + score.kept.contained,
        "support kept [%]": _ratio(score.kept.carried_kept, score.kept.carried),
        "pairs by force": score.borne,
        "pairs by force, left out": score.borne_left_out,
        "scenes not known by force": score.borne_unknown,
        "support kept, by force [%]": _ratio(score.borne_kept, score.borne),
        "containment kept [%]": _ratio(score.kept.contained_kept, score.kept.contained),
        "azimuth change, p90 [°]": _percentile(azimuths_known, 90.0, 180.0 / np.pi),
        "azimuth change, largest [°]": _percentile(azimuths_known, 100.0, 180.0 / np.pi),
        "first 0.1 s: speed, median [m/s]": _percentile(score.burst_speeds, 50.0, 1.0),
        "first 0.1 s: speed, p90 [m/s]": _percentile(score.burst_speeds, 90.0, 1.0),
        "bursting scenes [%]": _share([speed > BURST_SPEED for speed in score.burst_speeds]),
        "objects off the table": score.fallen,
        "objects left out": score.left_out,
        "CPU a scene, median [ms]": _percentile(score.seconds, 50.0, 1e3),
        "CPU a scene, p90 [ms]": _percentile(score.seconds, 90.0, 1e3),
    }


def _share(values: Sequence[bool]) -> float | None:
    return _ratio(sum(values), len(values))


def _ratio(some: int, of: int) -> float | None:
    return 100.0 * some / of if of else None


def _percentile(values: Sequence[float] | np.ndarray, percent: float, unit: float) -> float | None:
    return unit * float(np.percentile(values, percent)) if len(values) else None


def _add(score: LayoutScore, case: Case, result: Result, timestep_s: float) -> None:
    objects, pieces, poses = result.layout.placed.objects, result.layout.pieces, result.scene.poses
    scales = [placed.scale for placed in objects]
    score.piece_depths_m.append(_deepest(piece_penetrations(pieces, poses, scales)))
    score.mesh_depths_m.append(_deepest(mesh_penetrations([placed.mesh for placed in objects], poses, scales)))
    score.resting.append(not result.restless and stays(result.scene, timestep_s))
    score.burst_speeds.append(burst_speed(result.scene, timestep_s))
    score.fallen += len(result.scene.fallen)
    score.left_out += sum(placed.count for placed in case.item.objects) - len(objects)
    score.seconds.append(result.seconds)
    _add_seen(score, case, result)


def _add_seen(score: LayoutScore, case: Case, result: Result) -> None:
    """What is compared with the layout and the truth: a copy poured in to make up the number was never seen."""
    seen = [k for k, placed in enumerate(result.layout.placed.objects) if placed.copy_of is None]
    objects, pieces = [result.layout.placed.objects[k] for k in seen], [result.layout.pieces[k] for k in seen]
    poses, scales = [result.scene.poses[k] for k in seen], [placed.scale for placed in objects]
    ids = [placed.object_id for placed in objects]
    score.azimuth_changes_rad += case.azimuth_changes(dict(zip(ids, poses, strict=True))).tolist()
    if case.relations is not None:
        number = {placed.object_id: index for index, placed in enumerate(case.item.objects)}
        result_relations = relations_of(objects, pieces, poses, scales)
        score.kept += compare_relations(case.relations, result_relations.renumbered([number[name] for name in ids]))
    for placed, pose in zip(objects, poses, strict=True):
        center = _center(placed, pose, placed.scale)
        score.from_observed_m.append(float(np.linalg.norm(center - _center(placed, placed.pose, placed.scale))))
        if placed.object_id in case.truth:
            score.from_truth_m.append(float(np.linalg.norm(center - _center(placed, *case.truth[placed.object_id]))))


def _add_borne(score: LayoutScore, case: Case, result: Result, truth: TrueCarrying | None, timestep_s: float) -> None:
    """Compares who carries whom by force with the truth; what was left out carries nothing."""
    if truth is None:
        score.borne_unknown += 1
        return
    number = {placed.object_id: index for index, placed in enumerate(case.item.objects)}
    ids = [placed.copy_of or placed.object_id for placed in result.layout.placed.objects]
    now = {(number[ids[i]], number[ids[j]]) for i, j in carried_by_force(result.scene, timestep_s)}
    score.borne += len(truth.pairs)
    score.borne_kept += len(truth.pairs & now)
    score.borne_left_out += truth.left_out


def _deepest(depths: Sequence[tuple[int, int, float]]) -> float:
    return max((depth for _, _, depth in depths), default=0.0)


def _center(placed: PlacedObject, pose: Pose, scale: float) -> Vector3:
    """Where the centre of the mesh's own box stands in the table frame [m]."""
    center: Vector3 = transform_points(pose, box_center(placed.mesh)[None], scale)[0]
    return center
