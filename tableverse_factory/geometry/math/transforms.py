"""Rotations and rigid motions: quaternions wxyz, active, right-handed."""

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Matrix3, Matrix4, Points, Pose, Quaternion, Vector3


def identity_pose() -> Pose:
    """The pose that moves nothing."""
    return Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


def normalized_quaternion(quaternion_wxyz: Quaternion) -> Quaternion:
    """Unit length, real part not negative: one representative of q and -q.

    Raises:
        ValueError: if the length is zero or not finite.
    """
    q = np.asarray(quaternion_wxyz, dtype=np.float64)
    length = float(np.linalg.norm(q))
    if not np.isfinite(length) or length < 1e-9:
        raise ValueError(f"quaternion {q.tolist()} has no direction: give a unit quaternion wxyz")
    q = q / length
    sign = q[np.flatnonzero(q)[0]] if q[0] == 0.0 else q[0]
    return -q if sign < 0.0 else q


def rotation_matrix(quaternion_wxyz: Quaternion) -> Matrix3:
    """The matrix of a unit quaternion. Shape (3, 3)."""
    w, x, y, z = quaternion_wxyz
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_matrix(rotation: Matrix3) -> Quaternion:
    """The unit quaternion of a rotation matrix, stable for every angle (largest of four candidates)."""
    m = rotation
    four_squares = np.array(
        [
            1 + m[0, 0] + m[1, 1] + m[2, 2],
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    columns = np.array(
        [
            [four_squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], four_squares[1], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], four_squares[2], m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], four_squares[3]],
        ]
    )
    return normalized_quaternion(columns[int(np.argmax(four_squares))])


def quaternion_about_z(angle: float) -> Quaternion:
    """Rotation by `angle` [rad] about the vertical."""
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


def quaternion_from_rotation_vector(rotation_vector: Vector3) -> Quaternion:
    """Rotation about a vector by its length [rad]."""
    angle = float(np.linalg.norm(rotation_vector))
    axis = rotation_vector / angle if angle > 0.0 else np.zeros(3)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])


def multiply_quaternions(a_wxyz: Quaternion, b_wxyz: Quaternion) -> Quaternion:
    """The rotation that turns by `b` first and by `a` then."""
    w, x, y, z = a_wxyz
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    product: Float64[np.ndarray, "4"] = left @ b_wxyz
    return product


def rotation_angle(a_wxyz: Quaternion, b_wxyz: Quaternion) -> float:
    """Smallest angle between two orientations [rad]."""
    conjugate = np.asarray(a_wxyz) * np.array([1.0, -1.0, -1.0, -1.0])
    between = multiply_quaternions(conjugate, b_wxyz)
    return float(2 * np.arctan2(np.linalg.norm(between[1:]), abs(between[0])))


def pose_from_matrix(local_to_parent: Matrix4) -> Pose:
    """The pose of a homogeneous matrix."""
    return Pose(np.array(local_to_parent[:3, 3], dtype=np.float64), quaternion_from_matrix(local_to_parent[:3, :3]))


def matrix_from_pose(pose: Pose) -> Matrix4:
    """Homogeneous matrix. Shape (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(pose.quaternion_wxyz)
    matrix[:3, 3] = pose.position
    return matrix


def compose(parent: Pose, child: Pose) -> Pose:
    """`child` seen from the frame that `parent` is given in."""
    return Pose(
        transform_points(parent, child.position[None])[0],
        normalized_quaternion(multiply_quaternions(parent.quaternion_wxyz, child.quaternion_wxyz)),
    )


def inverse(pose: Pose) -> Pose:
    """The motion back."""
    conjugate = pose.quaternion_wxyz * np.array([1.0, -1.0, -1.0, -1.0])
    return Pose(-(rotation_matrix(conjugate) @ pose.position), conjugate)


def translated(pose: Pose, offset: Vector3) -> Pose:
    """The same orientation, moved by `offset` in the parent frame [m]."""
    return Pose(pose.position + offset, pose.quaternion_wxyz)


def transform_points(pose: Pose, points: Points, scale: float = 1.0) -> Points:
    """`R(q) @ (scale * point) + position` for each row. Shape (n, 3)."""
    moved: Points = scale * points @ rotation_matrix(pose.quaternion_wxyz).T + pose.position
    return moved
