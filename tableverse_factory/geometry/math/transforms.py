"""Rotations and rigid motions: quaternions wxyz, active, right-handed; conventions of axes."""

import numpy as np

from schemas.geometry import Matrix3, Matrix4, Points, Pose, Quaternion, Vector3

# Rotation from y up (glTF) to z up; its transpose goes back.
Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
# Half a turn about x, wxyz: from cameras that look along +z with y down to cameras that look along -z with y up.
OPENCV_TO_OPENGL = np.array([0.0, 1.0, 0.0, 0.0])


def identity_pose() -> Pose:
    """The pose that moves nothing."""
    return Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


def normalize_quaternion(quaternion_wxyz: Quaternion) -> Quaternion:
    """Scale a quaternion to unit length, real part not negative: one representative of q and -q."""
    q = np.asarray(quaternion_wxyz, dtype=np.float64)
    length = float(np.linalg.norm(q))
    if not np.isfinite(length) or length < 1e-9:
        raise ValueError(f"quaternion {q.tolist()} has no direction: give a unit quaternion wxyz")
    q = q / length
    sign = q[np.flatnonzero(q)[0]] if q[0] == 0.0 else q[0]
    return -q if sign < 0.0 else q


def rotation_matrix(quaternion_wxyz: Quaternion) -> Matrix3:
    """Rotation matrix of a unit quaternion. Shape (3, 3)."""
    w, x, y, z = quaternion_wxyz
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_matrix(rotation: Matrix3) -> Quaternion:
    """Unit quaternion of a rotation matrix, stable for every angle (largest of four candidates)."""
    m = rotation
    xx, yy, zz = np.diag(m)
    four_squares = np.array([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz])
    columns = np.array(
        [
            [four_squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], four_squares[1], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], four_squares[2], m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], four_squares[3]],
        ]
    )
    return normalize_quaternion(columns[int(np.argmax(four_squares))])


def quaternion_about_z(angle: float) -> Quaternion:
    """Rotation by `angle` [rad] about the vertical."""
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


def quaternion_from_rotation_vector(rotation_vector: Vector3) -> Quaternion:
    """Rotation about a vector by its length [rad]."""
    angle = float(np.linalg.norm(rotation_vector))
    axis = rotation_vector / angle if angle > 0.0 else np.zeros(3)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])


def multiply_quaternions(a_wxyz: Quaternion, b_wxyz: Quaternion) -> Quaternion:
    """Compose two rotations: `b` first, then `a`."""
    w, x, y, z = a_wxyz
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return left @ b_wxyz


def conjugate_quaternion(quaternion_wxyz: Quaternion) -> Quaternion:
    """The inverse rotation of a unit quaternion."""
    return quaternion_wxyz * np.array([1.0, -1.0, -1.0, -1.0])


def rotation_angle(a_wxyz: Quaternion, b_wxyz: Quaternion) -> float:
    """Smallest angle between two orientations [rad]."""
    between = multiply_quaternions(conjugate_quaternion(np.asarray(a_wxyz)), b_wxyz)
    return float(2 * np.arctan2(np.linalg.norm(between[1:]), abs(between[0])))


def pose_from_matrix(local_to_parent: Matrix4) -> Pose:
    """Pose of a homogeneous matrix."""
    return pose_from_rotation(local_to_parent[:3, 3], local_to_parent[:3, :3])


def pose_from_rotation(position: Vector3, rotation: Matrix3) -> Pose:
    """Pose of a position and a rotation matrix."""
    return Pose(np.array(position, dtype=np.float64), quaternion_from_matrix(rotation))


def matrix_from_pose(pose: Pose) -> Matrix4:
    """Homogeneous matrix. Shape (4, 4)."""
    return homogeneous_matrix(rotation_matrix(pose.quaternion_wxyz), pose.position)


def homogeneous_matrix(rotation: Matrix3, position: Vector3 | None = None) -> Matrix4:
    """Homogeneous matrix of a rotation and a translation, none by default. Shape (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = 0.0 if position is None else position
    return matrix


def compose_poses(parent: Pose, child: Pose) -> Pose:
    """Express `child`, given in the frame `parent`, in the frame that `parent` is given in."""
    return Pose(
        transform_points(parent, child.position[None])[0],
        normalize_quaternion(multiply_quaternions(parent.quaternion_wxyz, child.quaternion_wxyz)),
    )


def invert_pose(pose: Pose) -> Pose:
    """Invert a rigid motion."""
    conjugate = conjugate_quaternion(pose.quaternion_wxyz)
    return Pose(-(rotation_matrix(conjugate) @ pose.position), conjugate)


def translate_pose(pose: Pose, offset: Vector3) -> Pose:
    """Move a pose by `offset` in the parent frame [m]."""
    return Pose(pose.position + offset, pose.quaternion_wxyz)


def transform_points(pose: Pose, points: Points, scale: float = 1.0) -> Points:
    """Compute `R(q) @ (scale * point) + position` for each row. Shape (n, 3)."""
    return scale * points @ rotation_matrix(pose.quaternion_wxyz).T + pose.position


def cross_matrix(vector: Vector3) -> Matrix3:
    """The matrix M with `M @ a` the cross product of the vector and a, and `a @ M` that of a and the vector."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
