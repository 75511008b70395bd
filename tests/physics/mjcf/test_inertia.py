"""Mass properties against formulas, and meshes that are no solids."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.geometry.math.transforms import normalize_quaternion, rotation_matrix
from tableverse_factory.geometry.mesh.mass_integrals import integrate_volume
from tableverse_factory.geometry.mesh.meshes import from_trimesh, place_mesh
from tableverse_factory.physics.mjcf.inertia import MIN_GYRATION_M, compute_mass_properties, is_closed
from tests.helpers.simple_scenes import ball, box, cylinder

SIDES = st.floats(0.005, 0.5)


@given(SIDES, SIDES, SIDES, st.floats(0.01, 10.0))
def test_a_box_has_the_inertia_of_a_box(x: float, y: float, z: float, mass: float) -> None:
    found = compute_mass_properties(box(x, y, z), (box(x, y, z),), mass)
    expected = mass / 12 * np.diag([y * y + z * z, x * x + z * z, x * x + y * y])
    assert found.source == "mesh"
    assert found.volume_m3 == pytest.approx(x * y * z, rel=1e-9)
    np.testing.assert_allclose(found.inertia, expected, rtol=1e-9, atol=1e-12 * mass)


def test_a_cylinder_and_a_hollow_one() -> None:
    r, h, m = 0.04, 0.1, 0.3
    solid = cylinder(r, h, sections=720)
    found = compute_mass_properties(solid, (solid,), m)
    np.testing.assert_allclose(np.diag(found.inertia), [m / 12 * (3 * r * r + h * h)] * 2 + [m * r * r / 2], rtol=1e-4)
    inner = 0.037
    tube = from_trimesh(trimesh.creation.annulus(inner, r, h, sections=720))
    found = compute_mass_properties(tube, (solid,), m)
    squares = r * r + inner * inner
    np.testing.assert_allclose(
        np.diag(found.inertia), [m / 12 * (3 * squares + h * h)] * 2 + [m * squares / 2], rtol=1e-4
    )


@given(
    st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3),
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1),
)
def test_moving_the_mesh_moves_the_centre_and_turns_the_inertia(position: list[float], quaternion: list[float]) -> None:
    pose = Pose(np.array(position), normalize_quaternion(np.array(quaternion)))
    mesh = place_mesh(box(0.1, 0.06, 0.03), Pose(np.array([0.02, 0.0, 0.01]), np.array([1.0, 0, 0, 0])))
    before, after = (
        compute_mass_properties(mesh, (mesh,), 0.5),
        compute_mass_properties(place_mesh(mesh, pose), (mesh,), 0.5),
    )
    R = rotation_matrix(pose.quaternion_wxyz)
    np.testing.assert_allclose(after.center, R @ before.center + pose.position, atol=1e-9)
    np.testing.assert_allclose(after.inertia, R @ before.inertia @ R.T, atol=1e-10)


def test_mass_scales_inertia_alone() -> None:
    light, heavy = (compute_mass_properties(box(0.1, 0.1, 0.2), (box(0.1, 0.1, 0.2),), mass) for mass in (0.1, 0.7))
    np.testing.assert_allclose(light.with_mass(0.7).inertia, heavy.inertia, rtol=1e-12)


def test_an_open_mesh_weighs_as_its_pieces() -> None:
    whole = box(0.1, 0.1, 0.1)
    open_mesh = TriangleMesh(whole.vertices, whole.faces[:-2])
    left = place_mesh(box(0.06, 0.1, 0.1), Pose(np.array([-0.02, 0, 0]), np.array([1.0, 0, 0, 0])))
    right = place_mesh(box(0.06, 0.1, 0.1), Pose(np.array([0.02, 0, 0]), np.array([1.0, 0, 0, 0])))
    assert is_closed(whole)
    assert not is_closed(open_mesh)
    found = compute_mass_properties(open_mesh, (left, right), 0.3)
    expected = compute_mass_properties(whole, (whole,), 0.3)
    assert found.source == "pieces"
    assert found.volume_m3 == pytest.approx(1e-3, rel=1e-9)  # the overlap of the pieces counts once
    np.testing.assert_allclose(found.inertia, expected.inertia, rtol=1e-9, atol=1e-15)


def test_a_mesh_that_is_inside_out_is_not_believed() -> None:
    whole = box(0.1, 0.1, 0.1)
    inside_out = TriangleMesh(whole.vertices, whole.faces[:, ::-1].copy())
    assert compute_mass_properties(inside_out, (whole,), 1.0).source == "pieces"


@pytest.mark.parametrize("size", [(3e-6, 3e-6, 3e-6), (0.2, 0.2, 1e-5), (0.3, 1e-5, 1e-5)])
def test_tiny_and_flat_things_get_an_inertia_that_mujoco_takes(size: tuple[float, float, float]) -> None:
    inertia = compute_mass_properties(box(*size), (box(*size),), 0.002).inertia
    moments = np.linalg.eigvalsh(inertia)
    assert moments[0] >= 0.002 * MIN_GYRATION_M**2 * (1 - 1e-9)
    assert moments[0] + moments[1] >= moments[2] * (1 - 1e-12)


def test_the_volume_of_a_far_mesh_is_exact() -> None:
    far = place_mesh(ball(0.03), Pose(np.array([40.0, -30.0, 5.0]), np.array([1.0, 0, 0, 0])))
    assert integrate_volume(far)[0] == pytest.approx(integrate_volume(ball(0.03))[0], rel=1e-6)


@pytest.mark.parametrize("inside_out", [False, True])
@pytest.mark.parametrize("apart", [0.06, 0.08, 0.12])
def test_the_mass_of_several_shells_is_that_of_the_shape(apart: float, inside_out: bool) -> None:
    # A cube, and a smaller one that sticks out of it or stands beside it, perhaps turned the wrong way by its maker.
    large, small = trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.box((0.05, 0.05, 0.05))
    small.apply_translation([apart, 0.0, 0.0])
    if inside_out:
        small.invert()
    both = from_trimesh(trimesh.util.concatenate([large, small]))
    found = compute_mass_properties(both, (box(0.3, 0.1, 0.1),), 1.0)
    rest = min(apart + 0.025 - 0.05, 0.05)  # of the smaller one's length, beyond the other
    volume = 1e-3 + rest * 0.05**2
    assert found.source == "mesh"
    assert found.volume_m3 == pytest.approx(volume, rel=1e-9)
    np.testing.assert_allclose(found.center, [rest * 0.05**2 * (apart + 0.025 - rest / 2) / volume, 0, 0], atol=1e-9)
