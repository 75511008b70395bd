"""What shells enclose together, against unions of boxes and volumes that are known."""

import manifold3d
import numpy as np
import pytest
import trimesh
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume, integrate_volume
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.mesh.shells import is_one_shell, unite_shells
from tests.helpers.bad_meshes import joined, shifted

SIDES = st.tuples(*[st.floats(0.02, 0.1)] * 3)
AT = st.tuples(*[st.floats(-0.06, 0.06)] * 3)
BOXES = st.lists(st.tuples(SIDES, AT, st.integers(0, 2**31)), min_size=1, max_size=4)


def cube(side: float) -> TriangleMesh:
    return from_trimesh(trimesh.creation.box((side, side, side)))


def inside_out(mesh: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, mesh.faces[:, ::-1].copy())


def turned_box(sides: tuple[float, ...], at: tuple[float, ...], turn: int) -> TriangleMesh:
    box = trimesh.creation.box(sides)
    return from_trimesh(box.apply_transform(_transform(at, turn)))


@pytest.mark.heavy
@settings(max_examples=50)
@given(BOXES, st.booleans())
@example([((0.1, 0.1, 0.1), (0.0, 0.0, 0.0), 0), ((0.05, 0.05, 0.05), (0.06, 0.03, 0.0), 1)], True)
def test_overlaps_count_once_and_a_shell_that_sticks_out_adds_whichever_way_it_is_turned(boxes, flipped):
    shells = [turned_box(*box) for box in boxes]
    union = manifold3d.Manifold()
    for sides, at, turn in boxes:
        union += manifold3d.Manifold.cube(list(sides), True).transform(_transform(at, turn)[:3])
    # The smallest of them, if any, is inside out; within the others it would be a hollow.
    order = sorted(range(len(boxes)), key=lambda k: -compute_signed_volume(shells[k]))
    if flipped and len(shells) > 1:
        rest = manifold3d.Manifold()
        for k in order[:-1]:
            sides, at, turn = boxes[k]
            rest += manifold3d.Manifold.cube(list(sides), True).transform(_transform(at, turn)[:3])
        assume(union.volume() - rest.volume() > 0.02 * compute_signed_volume(shells[order[-1]]))
        shells[order[-1]] = inside_out(shells[order[-1]])
    found = unite_shells(joined(*shells))
    assert compute_signed_volume(found) == pytest.approx(float(union.volume()), rel=1e-9)


def test_a_hollow_may_be_larger_than_each_of_the_shells_around_it():
    halves = [from_trimesh(trimesh.creation.box((0.06, 0.1, 0.1))) for _ in range(2)]
    walls = joined(shifted(halves[0], -0.02, 0.0, 0.0), shifted(halves[1], 0.02, 0.0, 0.0), inside_out(cube(0.09)))
    assert compute_signed_volume(unite_shells(walls)) == pytest.approx(0.1**3 - 0.09**3, rel=1e-9)


def test_a_hollow_stays_one_and_what_is_in_it_stays_there():
    nested = joined(cube(0.1), inside_out(cube(0.08)), shifted(cube(0.02), 0.01, 0.0, 0.0))
    volume, center, _ = integrate_volume(unite_shells(nested))
    assert volume == pytest.approx(0.1**3 - 0.08**3 + 0.02**3, rel=1e-9)
    assert center == pytest.approx([0.01 * 0.02**3 / volume, 0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize(
    "mesh",
    [
        cube(0.1),
        joined(cube(0.1), shifted(cube(0.05), 0.2, 0.0, 0.0)),
        joined(cube(0.1), inside_out(cube(0.08))),
        joined(inside_out(cube(0.08)), cube(0.1), cube(0.05)),
    ],
    ids=["one", "two apart", "a hollow", "one in a hollow"],
)
def test_a_mesh_with_nothing_amiss_is_left_alone(mesh):
    assert unite_shells(mesh) is mesh


def _transform(at: tuple[float, ...], turn: int) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.random(random_state=turn).as_matrix(), at
    return matrix


def test_shells_are_counted():
    ball = trimesh.creation.icosphere(2, 0.01)
    apart = trimesh.util.concatenate([ball, ball.copy().apply_translation([0.1, 0, 0])])
    assert is_one_shell(from_trimesh(ball))
    assert not is_one_shell(from_trimesh(apart))
