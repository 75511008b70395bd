"""What is left of a mesh for a neighbour shares with it exactly what the whole mesh shares."""

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.collision.broad_phase import crop_to_half_space, find_separating_slab
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.mesh.repair import mesh_to_solid
from tests.helpers.examples import scale_examples


def bowl() -> trimesh.Trimesh:
    profile = [[0.0, 0.0], [0.04, 0.0], [0.06, 0.05], [0.055, 0.05], [0.036, 0.005], [0.0, 0.005]]
    return trimesh.creation.revolve(profile, sections=48)


SHAPES = {
    "ball": trimesh.creation.icosphere(3, 0.05),
    "ring": trimesh.creation.torus(0.05, 0.015, 48, 24),
    "bowl": bowl(),
    "box": trimesh.creation.box((0.08, 0.05, 0.06)).subdivide().subdivide().subdivide(),
}
NAMES = st.sampled_from(sorted(SHAPES))
AT = st.tuples(*[st.floats(-0.11, 0.11)] * 3)
TURNS = st.integers(0, 2**31)


def placed(name: str, at: tuple[float, ...], turn: int) -> TriangleMesh:
    mesh = SHAPES[name].copy()
    mesh.apply_transform(np.block([[Rotation.random(random_state=turn).as_matrix(), np.array([at]).T], [0, 0, 0, 1]]))
    return from_trimesh(mesh)


@pytest.mark.heavy
@settings(max_examples=scale_examples(200))
@given(NAMES, NAMES, AT, TURNS, TURNS)
# Where faces are flat, a cut that folds them within their plane loses part of what is shared, or all of it.
@example("ball", "box", (0.03125, 0.03125, 0.03125), 0, 3062)
@example("ball", "box", (0.06798981, -0.04191067, 0.06829734), 873121608, 1039190937)
@example("bowl", "box", (0.01476299, 0.05342445, 0.07274368), 1240912316, 861794690)
@example("box", "box", (0.01567514, -0.05742329, 0.06213419), 148045667, 1451008148)
def test_the_same_is_shared(a, b, apart, turn_a, turn_b):
    one, other = placed(a, (0.0, 0.0, 0.0), turn_a), placed(b, apart, turn_b)
    whole = mesh_to_solid(one) ^ mesh_to_solid(other)
    slab = find_separating_slab(one.vertices, other.vertices)
    if slab.is_gap:
        assert whole.is_empty()
        return
    some, of_other = (
        crop_to_half_space(one, slab.normal, slab.high),
        crop_to_half_space(other, -slab.normal, -slab.low),
    )
    less = mesh_to_solid(some or one) ^ mesh_to_solid(of_other or other)
    assert less.volume() == pytest.approx(whole.volume(), abs=1e-15)
    assert less.surface_area() == pytest.approx(whole.surface_area(), abs=1e-12)


@pytest.mark.heavy
@given(NAMES, NAMES, AT, TURNS)
def test_each_lies_on_its_side_of_the_slab(a, b, apart, turn):
    one, other = placed(a, (0.0, 0.0, 0.0), turn), placed(b, apart, turn + 1)
    slab = find_separating_slab(one.vertices, other.vertices)
    assert np.linalg.norm(slab.normal) == pytest.approx(1.0, abs=1e-12)
    assert (one.vertices @ slab.normal).min() == pytest.approx(slab.low, abs=1e-12)
    assert (other.vertices @ slab.normal).max() == pytest.approx(slab.high, abs=1e-12)


@pytest.mark.heavy
@given(st.floats(2e-3, 0.05), TURNS)
def test_between_what_stands_side_by_side_there_is_a_gap(apart, turn):
    # Whatever way two balls lie; the axes alone would find no gap between most of them.
    away = Rotation.random(random_state=turn).as_matrix() @ [0.1 + apart, 0.0, 0.0]
    slab = find_separating_slab(
        placed("ball", (0.0, 0.0, 0.0), turn).vertices, placed("ball", tuple(away), turn).vertices
    )
    assert slab.is_gap
    assert slab.low - slab.high <= apart + 1e-3


def test_points_that_coincide_have_no_gap():
    points = placed("box", (0.0, 0.0, 0.0), 0).vertices
    slab = find_separating_slab(points, points)
    assert not slab.is_gap
    assert np.isfinite(slab.normal).all()


def test_of_what_stands_on_a_table_the_foot_is_left():
    ball = placed("ball", (0.0, 0.0, 0.0499), 0)
    table = trimesh.creation.box((2.0, 2.0, 0.04)).apply_translation([0.0, 0.0, -0.02]).vertices
    slab = find_separating_slab(ball.vertices, table)
    foot = crop_to_half_space(ball, slab.normal, slab.high)
    assert foot is not None
    assert len(foot.faces) < 0.05 * len(ball.faces)


def test_of_what_leans_the_touching_side_is_left():
    ball = placed("ball", (0.0, 0.0, 0.0), 0)
    other = ball.vertices + 0.0999 * np.array([1.0, 1.0, 1.0]) / np.sqrt(3.0)
    slab = find_separating_slab(ball.vertices, other)
    side = crop_to_half_space(ball, slab.normal, slab.high)
    assert side is not None
    assert len(side.faces) < 0.05 * len(ball.faces)


def test_what_is_all_on_the_side_of_the_other_stays_whole():
    ball = placed("ball", (0.0, 0.0, 0.0), 0)
    assert crop_to_half_space(ball, np.array([0.0, 0.0, 1.0]), 1.0) is None
