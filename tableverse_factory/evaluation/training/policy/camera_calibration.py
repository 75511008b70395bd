"""Calibration of an arm's cameras: pose and focal length from the depth of the arm itself and of the table."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Self

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from schemas.geometry import DepthImage, Frozen, Points
from tableverse_factory.evaluation.training.policy.mounts import mount_cameras
from tableverse_factory.evaluation.training.policy.views import load_figure
from tableverse_factory.evaluation.training.policy.windows import thin_eye
from tableverse_factory.geometry.math.camera import PosedCamera, backproject
from tableverse_factory.geometry.math.transforms import identity_pose, pose_from_rotation, rotation_matrix
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.physics.render.raycast import Raycaster

REACHES_M = (*[0.09] * 8, *[0.06] * 6, *[0.03] * 5, *[0.015] * 5, *[0.008] * 4)  # to the arm, step by step
ALIKE = 0.6  # least cosine between normals of points that are taken for the same
LEVEL = 0.9  # least cosine between the vertical and a normal of the table
TABLE_REACH_M = 0.05
EDGE = 0.1  # change of depth between the neighbours of a pixel, as a share of it, that is an edge
WIDE = 0.88  # of the focal length with which the arm is drawn: a displaced camera sees more of it
LEAST_PIXELS = 100  # of the arm
NOISE_M = 0.002  # of a point, in the mean over as many as count as independent
INDEPENDENT = 1000
EXPECTED = np.array([*[0.02] * 3, *[0.0175] * 3, 0.023])  # deviations of a displacement: turn [rad], shift [m], zoom


@dataclass(frozen=True, slots=True, eq=False)
class ArmSurface(Frozen):
    """What a camera sees of the arm at home: points and normals in the frame of the arm's base."""

    points: Points
    normals: Points
    tree: KDTree

    @classmethod
    def draw(cls, robot: str, eye: PosedCamera) -> Self:
        """Draw the arm as a camera in the frame of its base sees it, and a little more."""
        thin = thin_eye(eye)
        camera = replace(thin.camera, fx=WIDE * thin.camera.fx, fy=WIDE * thin.camera.fy)
        hits = _load_home(robot).cast(camera, thin.camera_to_table)
        points = hits.points.astype(np.float64)
        return cls(points, hits.normals.astype(np.float64), KDTree(points))


@cache
def load_surfaces(robot: str) -> tuple[ArmSurface, ...]:
    """Load what each camera of an arm sees of it, once in a process."""
    return tuple(ArmSurface.draw(robot, eye) for eye in mount_cameras(robot))


@cache
def _load_home(robot: str) -> Raycaster:
    """Load an arm at home, its fingers open, on its pedestal."""
    figure, still = load_figure(robot), identity_pose()
    parts = [place_mesh(*part) for part in zip(figure.meshes, figure.home_poses(still), strict=True)]
    return Raycaster([figure.pedestal(still), *parts])


def calibrate_camera(depth: DepthImage, eye: PosedCamera, surface: ArmSurface) -> PosedCamera:
    """Find where a camera is that is displaced by some centimetres and degrees, and its focal length.

    Points that it sees are drawn onto the arm, which stands at home, and onto the table, the plane z = 0, along their
    normals, by least squares whose weights fall with the distance. What else is seen is far from both, or level with
    neither. A camera that sees too little of the arm is returned as it is.

    Args:
        depth: As the camera of `thin_eye` sees it, 0 where nothing is [m].
        eye: The camera as it is said to be, in the frame of the arm's base.
        surface: What `eye` sees of the arm.
    """
    cloud = backproject(depth, thin_eye(eye).camera)
    normals, smooth = _compute_normals(cloud, depth > 0)
    seen, facing = cloud[smooth], normals[smooth]
    turn, at, zoom = rotation_matrix(eye.camera_to_table.quaternion_wxyz), eye.camera_to_table.position, 1.0
    total = np.zeros(7)
    for reach in REACHES_M:
        local = seen / [zoom, zoom, 1.0]
        points, own = local @ turn.T + at, facing @ turn.T
        along, away, on_arm = _match(points, own, surface, reach)
        used = np.isfinite(away)
        if (arm := int(on_arm.sum())) < LEAST_PIXELS:
            return eye
        weights = 1.0 / (1.0 + (4.0 * away[used] / reach) ** 2)
        table = ~on_arm[used]
        weights[table] *= min(1.0, 0.5 * arm / max(int(table.sum()), 1))
        lever = np.cross(points[used] - at, along[used])
        spread = -np.einsum("ij,ij->i", (local[used] * [1.0, 1.0, 0.0]) @ turn.T, along[used]) / zoom
        change = np.column_stack([lever, along[used], spread])
        scale = NOISE_M**2 * len(change) / INDEPENDENT
        weighed = change * weights[:, None]
        matrix = weighed.T @ change / scale + np.diag(EXPECTED**-2.0)
        step = np.linalg.solve(matrix, -weighed.T @ away[used] / scale - total * EXPECTED**-2.0)
        turn, at, zoom = Rotation.from_rotvec(step[:3]).as_matrix() @ turn, at + step[3:6], zoom + step[6]
        total += step
    camera = replace(eye.camera, fx=zoom * eye.camera.fx, fy=zoom * eye.camera.fy)
    return PosedCamera(camera, pose_from_rotation(at, turn))


def _match(
    points: Points, normals: Points, surface: ArmSurface, reach_m: float
) -> tuple[Points, np.ndarray, np.ndarray]:
    """Match points to the arm, else to the table: normals there, distances along them, and which are on the arm.

    The distance is NaN for what is on neither.
    """
    distance, nearest = surface.tree.query(points, distance_upper_bound=reach_m)
    nearest = np.where(np.isfinite(distance), nearest, 0)
    along = surface.normals[nearest]
    on_arm = np.isfinite(distance) & (np.einsum("ij,ij->i", along, normals) > ALIKE)
    away = np.where(on_arm, np.einsum("ij,ij->i", along, points - surface.points[nearest]), np.nan)
    level = ~on_arm & (normals[:, 2] > LEVEL) & (np.abs(points[:, 2]) < min(reach_m, TABLE_REACH_M))
    along[level] = [0.0, 0.0, 1.0]
    away[level] = points[level, 2]
    return along, away, on_arm


def _compute_normals(cloud: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute normals towards the camera, and where they are known: not at edges. Shapes (h, w, 3) and (h, w)."""
    across, down = cloud[1:-1, 2:] - cloud[1:-1, :-2], cloud[2:, 1:-1] - cloud[:-2, 1:-1]
    inner = np.cross(down, across)  # towards the camera: x is to the right, y down, z ahead
    inner /= np.maximum(np.linalg.norm(inner, axis=2, keepdims=True), 1e-12)
    change = np.maximum(np.abs(across[..., 2]), np.abs(down[..., 2]))
    smooth = change < EDGE * cloud[1:-1, 1:-1, 2]
    around = known[1:-1, 2:] & known[1:-1, :-2] & known[2:, 1:-1] & known[:-2, 1:-1]
    border = ((1, 1), (1, 1))
    return np.pad(inner, (*border, (0, 0))), np.pad(smooth & around, border) & known
