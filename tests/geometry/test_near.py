"""What is left of a mesh for a neighbour shares with it exactly what the whole mesh shares."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.meshes import bounds, from_trimesh
from tableverse_factory.geometry.near import is_one_shell, near
from tableverse_factory.geometry.repair import as_solid


def bowl() -> trimesh.Trimesh:
    profile = [[0.0, 0.0], [0.04, 0.0], [0.06, 0.05], [0.055, 0.05], [0.036, 0.005], [0.0, 0.005]]
    return trimesh.creation.revolve(profile, sections=48)


SHAPES = {
    "ball": trimesh.creation.icosphere(3, 0.05),
    "ring": trimesh.creation.torus(0.05, 0.015, 48, 24),
    "bowl": bowl(),
    "box": trimesh.creation.box((0.08, 0.05, 0.06)).subdivide().subdivide().subdivide(),
}
AT = st.tuples(*[st.floats(-0.11, 0.11)] * 3)
TURNS = st.integers(0, 2**31)


def placed(name: str, at: tuple[float, ...], turn: int) -> TriangleMesh:
    mesh = SHAPES[name].copy()
    mesh.apply_transform(np.block([[Rotation.random(random_state=turn).as_matrix(), np.array([at]).T], [0, 0, 0, 1]]))
    return from_trimesh(mesh)


@given(st.sampled_from(sorted(SHAPES)), st.sampled_from(sorted(SHAPES)), AT, TURNS, TURNS)
def test_the_same_is_shared(a, b, apart, turn_a, turn_b):
    one, other = placed(a, (0.0, 0.0, 0.0), turn_a), placed(b, apart, turn_b)
    some, of_other = near(one, *bounds(other)), near(other, *bounds(one))
    whole = as_solid(one) ^ as_solid(other)
    less = as_solid(some or one) ^ as_solid(of_other or other)
    assert less.volume() == pytest.approx(whole.volume(), abs=1e-15)
    assert less.surface_area() == pytest.approx(whole.surface_area(), abs=1e-12)


def test_of_what_stands_on_a_table_the_foot_is_left():
    ball = placed("ball", (0.0, 0.0, 0.0499), 0)
    foot = near(ball, np.array([-1.0, -1.0, -0.04]), np.array([1.0, 1.0, 0.0]))
    assert foot is not None
    assert len(foot.faces) < 0.05 * len(ball.faces)


def test_what_is_all_on_the_side_of_the_other_stays_whole():
    ball = placed("ball", (0.0, 0.0, 0.0), 0)
    assert near(ball, np.full(3, -1.0), np.full(3, 1.0)) is None


def test_shells_are_counted():
    ball = trimesh.creation.icosphere(2, 0.01)
    apart = trimesh.util.concatenate([ball, ball.copy().apply_translation([0.1, 0, 0])])
    assert is_one_shell(from_trimesh(ball))
    assert not is_one_shell(from_trimesh(apart))
