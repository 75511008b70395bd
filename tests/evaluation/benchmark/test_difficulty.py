"""Difficulty: known gaps are measured, and less room is never easier."""

import numpy as np
import pytest

from schemas.curation import Relation
from schemas.geometry import Pose
from tableverse_factory.evaluation.benchmark.difficulty import MAX_GAP_M, measure_difficulty
from tableverse_factory.physics.mjcf.scene_objects import make_scene_object
from tests.helpers.simple_scenes import box

X, Y, OTHER = "x", "y", "other"
TIERS = ("easy", "medium", "hard")


def block(name, x, y=0.0, size=0.04):
    mesh = box(size, size, size)
    return make_scene_object(name, mesh, (mesh,), Pose(np.array([x, y, size / 2]), np.array([1.0, 0, 0, 0])), 0.1)


def measure(free_m, clearance_m, relation=Relation.NEXT_TO):
    """X at the origin with another block at `free_m`; its goal is `clearance_m` to the left of a third one."""
    objects = {
        X: block(X, 0.0), Y: block(Y, 0.0, 0.6), OTHER: block(OTHER, -0.04 - free_m), "wall": block("wall", 0.5)
    }  # fmt: skip
    goal = Pose(np.array([0.5 - 0.04 - clearance_m, 0.0, 0.02]), np.array([1.0, 0, 0, 0]))
    return measure_difficulty(objects, X, Y, relation, goal)


def test_gaps_are_those_of_the_blocks():
    found = measure(0.03, 0.02)
    assert (found.free_m, found.clearance_m) == (pytest.approx(0.03, abs=1e-5), pytest.approx(0.02, abs=1e-5))


def test_less_room_is_never_easier_and_all_tiers_exist():
    seen = []
    for relation in (Relation.NEXT_TO, Relation.ON, Relation.IN):
        ranks = [[TIERS.index(measure(f, c, relation).tier) for c in (0.1, 0.02, 0.005)] for f in (0.1, 0.02, 0.005)]
        assert (np.diff(ranks, axis=0) >= 0).all()
        assert (np.diff(ranks, axis=1) >= 0).all()
        seen.append(np.array(ranks))
    assert (seen[0] <= seen[1]).all()
    assert (seen[1] <= seen[2]).all()
    assert {TIERS[rank] for rank in np.unique(seen)} == set(TIERS)


def test_what_carries_x_takes_no_room_from_it():
    alone = {X: block(X, 0.0), Y: block(Y, 0.5)}
    far = Pose(np.array([0.0, 0.4, 0.02]), np.array([1.0, 0, 0, 0]))
    assert measure_difficulty(alone, X, Y, Relation.ON, far).free_m == pytest.approx(0.46, abs=1e-5)
    on_y = Pose(np.array([0.5, 0.0, 0.06]), np.array([1.0, 0, 0, 0]))
    assert measure_difficulty(alone, X, Y, Relation.ON, on_y).clearance_m == MAX_GAP_M
