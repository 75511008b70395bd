"""Rigid motions form a group, and the three ways to write a rotation agree."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from schemas.geometry import Pose
from tableverse_factory.geometry.math.transforms import (
    compose_poses,
    identity_pose,
    invert_pose,
    matrix_from_pose,
    multiply_quaternions,
    normalize_quaternion,
    pose_from_matrix,
    quaternion_about_z,
    quaternion_from_matrix,
    rotation_angle,
    rotation_matrix,
    transform_points,
    translate_pose,
)

units = st.floats(-1.0, 1.0, width=32)
vectors = arrays(np.float64, 3, elements=st.floats(-10.0, 10.0, width=32))
quaternions = arrays(np.float64, 4, elements=units).filter(lambda q: np.linalg.norm(q) > 0.1).map(normalize_quaternion)
poses = st.builds(Pose, vectors, quaternions)
points = arrays(np.float64, (5, 3), elements=st.floats(-10.0, 10.0, width=32))


def assert_same_motion(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose(matrix_from_pose(a), matrix_from_pose(b), atol=1e-9)


@pytest.mark.heavy
@given(quaternions)
def test_a_rotation_keeps_lengths_and_handedness(q):
    R = rotation_matrix(q)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


@given(quaternions)
def test_quaternion_and_matrix_are_one_rotation(q):
    np.testing.assert_allclose(quaternion_from_matrix(rotation_matrix(q)), q, atol=1e-9)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_come_back(axis):
    """Where the real part vanishes, formulas that divide by it fail."""
    q = np.zeros(4)
    q[1 + axis] = 1.0
    np.testing.assert_allclose(quaternion_from_matrix(rotation_matrix(q)), q, atol=1e-12)


@pytest.mark.heavy
@given(quaternions, quaternions)
def test_products_of_quaternions_are_products_of_matrices(a, b):
    expected = rotation_matrix(a) @ rotation_matrix(b)
    np.testing.assert_allclose(rotation_matrix(multiply_quaternions(a, b)), expected, atol=1e-12)


@pytest.mark.heavy
@given(quaternions)
def test_a_quaternion_and_its_negative_are_written_alike(q):
    np.testing.assert_array_equal(normalize_quaternion(-q), normalize_quaternion(q))
    assert np.linalg.norm(normalize_quaternion(3.7 * q)) == pytest.approx(1.0)


@pytest.mark.parametrize("bad", [np.zeros(4), np.full(4, np.nan), np.array([np.inf, 0, 0, 0])])
def test_a_quaternion_without_direction_is_refused(bad):
    with pytest.raises(ValueError, match="wxyz"):
        normalize_quaternion(bad)


@pytest.mark.heavy
@given(poses, poses, poses)
def test_motions_are_a_group(a, b, c):
    assert_same_motion(compose_poses(compose_poses(a, b), c), compose_poses(a, compose_poses(b, c)))
    assert_same_motion(compose_poses(a, identity_pose()), a)
    assert_same_motion(compose_poses(identity_pose(), a), a)
    assert_same_motion(compose_poses(a, invert_pose(a)), identity_pose())
    assert_same_motion(compose_poses(invert_pose(a), a), identity_pose())


@pytest.mark.heavy
@given(poses, poses)
def test_composition_is_the_product_of_matrices(a, b):
    np.testing.assert_allclose(
        matrix_from_pose(compose_poses(a, b)), matrix_from_pose(a) @ matrix_from_pose(b), rtol=0, atol=1e-9
    )


@pytest.mark.heavy
@given(poses)
def test_matrix_and_pose_are_one_motion(pose):
    assert_same_motion(pose_from_matrix(matrix_from_pose(pose)), pose)


@pytest.mark.heavy
@given(poses, poses, points)
def test_moving_points_twice_is_moving_them_by_the_composition(a, b, p):
    np.testing.assert_allclose(
        transform_points(a, transform_points(b, p)), transform_points(compose_poses(a, b), p), rtol=0, atol=1e-9
    )


@pytest.mark.heavy
@given(poses, points, st.floats(0.1, 10.0))
def test_scale_comes_before_the_motion(pose, p, scale):
    by_hand = (rotation_matrix(pose.quaternion_wxyz) @ (scale * p).T).T + pose.position
    np.testing.assert_allclose(transform_points(pose, p, scale), by_hand, rtol=0, atol=1e-9)


@given(poses, vectors)
def test_translation_is_seen_from_the_parent(pose, offset):
    moved = translate_pose(pose, offset)
    np.testing.assert_array_equal(moved.quaternion_wxyz, pose.quaternion_wxyz)
    np.testing.assert_allclose(moved.position - pose.position, offset, atol=1e-12)


@given(st.floats(-3.1, 3.1))
def test_the_angle_about_z_is_the_angle(angle):
    q = quaternion_about_z(angle)
    assert rotation_angle(identity_pose().quaternion_wxyz, q) == pytest.approx(abs(angle), abs=1e-9)
    np.testing.assert_allclose(rotation_matrix(q) @ [1, 0, 0], [np.cos(angle), np.sin(angle), 0], atol=1e-12)


@given(quaternions, quaternions, quaternions)
def test_the_angle_is_a_distance(a, b, c):
    assert rotation_angle(a, a) == pytest.approx(0.0, abs=1e-7)
    assert rotation_angle(a, -a) == pytest.approx(0.0, abs=1e-7)
    assert rotation_angle(a, b) == pytest.approx(rotation_angle(b, a), abs=1e-9)
    assert rotation_angle(a, c) <= rotation_angle(a, b) + rotation_angle(b, c) + 1e-7
    assert 0.0 <= rotation_angle(a, b) <= np.pi + 1e-9


@given(poses)
def test_a_pose_cannot_be_changed(pose):
    with pytest.raises(ValueError, match="read-only"):
        pose.position[0] = 1.0
    with pytest.raises(AttributeError):
        pose.position = np.zeros(3)
