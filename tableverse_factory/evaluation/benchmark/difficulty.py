"""Difficulty of a task, measured: room around the object, room around its goal, and the relation."""

from collections.abc import Mapping

from schemas.curation import Relation
from schemas.geometry import Pose
from tableverse_factory.evaluation.benchmark.benchmark import DifficultyRecord, Tier
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.relations.relations import (
    BodyFeatures,
    compute_body_features,
    measure_outline_gap,
    rests_on,
)
from tableverse_factory.physics.mjcf.scene_objects import SceneObject
from tableverse_factory.robotics.execution.goal import RESTING_RELATIONS

FREE_M = (0.015, 0.04)  # less room around the object than the first gives two points, than the second one
CLEARANCE_M = (0.01, 0.03)  # the same of the room around its goal
POINTS: Mapping[Relation, int] = {Relation.ON: 1, **dict.fromkeys((Relation.IN, Relation.INTO, Relation.INSIDE), 2)}
LEAST_POINTS: Mapping[Tier, int] = {"hard": 4, "medium": 2, "easy": 0}
MAX_GAP_M = 1.0  # of what stands alone


def measure_difficulty(
    objects: Mapping[str, SceneObject], x_id: str, y_id: str, relation: Relation, placed: Pose
) -> DifficultyRecord:
    """Measure the difficulty of carrying X to where a recorded motion put it.

    Gaps are horizontal, between convex outlines [m]: of X, as it stands, to all objects but those that carry it; and of
    X at `placed` to all other objects, but Y where Y carries it then.
    """
    bodies = {name: thing.body for name, thing in objects.items() if name != x_id}
    x = objects[x_id]
    free_m = _measure_least_gap(x.body, [body for body in bodies.values() if not rests_on(x.body, body)])
    goal = compute_body_features(place_mesh(x.mesh, placed))
    around = [body for name, body in bodies.items() if not (name == y_id and relation in RESTING_RELATIONS)]
    clearance_m = _measure_least_gap(goal, around)
    points = sum((_rate(free_m, FREE_M), _rate(clearance_m, CLEARANCE_M), POINTS.get(relation, 0)))
    tier = next(tier for tier, least in LEAST_POINTS.items() if points >= least)
    return DifficultyRecord(tier=tier, free_m=free_m, clearance_m=clearance_m)


def _measure_least_gap(body: BodyFeatures, others: list[BodyFeatures]) -> float:
    return round(min((MAX_GAP_M, *(measure_outline_gap(body, other) for other in others))), 6)


def _rate(gap_m: float, bounds_m: tuple[float, float]) -> int:
    return sum(gap_m < bound for bound in bounds_m)
