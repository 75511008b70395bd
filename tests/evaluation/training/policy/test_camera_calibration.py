"""Calibration of cameras: a displaced one is found to a millimetre, and one that sees no arm stays where it is."""

import numpy as np
import pytest

from schemas.geometry import DepthImage, TriangleMesh
from tableverse_factory.delivery.learning.variation import draw_camera_shift
from tableverse_factory.evaluation.training.policy.camera_calibration import calibrate_camera, load_surfaces
from tableverse_factory.evaluation.training.policy.mounts import mount_cameras
from tableverse_factory.evaluation.training.policy.views import load_figure
from tableverse_factory.evaluation.training.policy.windows import thin_eye
from tableverse_factory.geometry.math.camera import PosedCamera, backproject
from tableverse_factory.geometry.math.transforms import identity_pose, transform_points
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.physics.mjcf.scenery import make_box_mesh
from tableverse_factory.physics.render.raycast import Raycaster


def cast_depth(caster: Raycaster, eye: PosedCamera) -> DepthImage:
    thin = thin_eye(eye)
    hits = caster.cast(thin.camera, thin.camera_to_table)
    depth = np.zeros((thin.camera.height, thin.camera.width), dtype=np.float32)
    depth.ravel()[hits.pixels] = hits.depth
    return depth


ROBOT = "panda"


@pytest.fixture(scope="module")
def caster() -> Raycaster:
    figure, still = load_figure(ROBOT), identity_pose()
    parts = [place_mesh(mesh, pose) for mesh, pose in zip(figure.meshes, figure.home_poses(still), strict=True)]
    things = [
        make_box((x, x + 0.1), (y, y + 0.07), (0.0, height))
        for x, y, height in ((0.5, -0.1, 0.02), (0.62, 0.12, 0.11), (0.5, 0.2, 0.2))
    ]
    return Raycaster([make_table(), *things, *parts, figure.pedestal(still)])


def make_box(*ends: tuple[float, float]) -> TriangleMesh:
    low, high = np.transpose(ends)
    mesh = make_box_mesh((high - low) / 2)
    return TriangleMesh(mesh.vertices + (high + low) / 2, mesh.faces)


def make_table() -> TriangleMesh:
    return make_box((0.45, 1.1), (-0.4, 0.4), (-0.03, 0.0))


def test_a_displaced_camera_is_found(caster: Raycaster) -> None:
    rng = np.random.default_rng(8)
    for _ in range(4):
        shift = draw_camera_shift(rng)
        for eye, surface in zip(mount_cameras(ROBOT), load_surfaces(ROBOT), strict=True):
            true = shift.displace(eye)
            depth = cast_depth(caster, true)
            found = calibrate_camera(depth, eye, surface)
            off, before = (
                np.linalg.norm(lift_table(depth, camera) - lift_table(depth, true), axis=1) for camera in (found, eye)
            )
            assert np.median(off) < 0.003 < np.median(before)


def lift_table(depth: DepthImage, eye: PosedCamera) -> np.ndarray:
    thin = thin_eye(eye)
    points: np.ndarray = transform_points(thin.camera_to_table, backproject(depth, thin.camera)[depth > 0])
    return points


def test_a_camera_that_sees_no_arm_stays() -> None:
    eye, surface = mount_cameras(ROBOT)[0], load_surfaces(ROBOT)[0]
    assert calibrate_camera(cast_depth(Raycaster([make_table()]), eye), eye, surface) is eye
    nothing = np.zeros((thin_eye(eye).camera.height, thin_eye(eye).camera.width), dtype=np.float32)
    assert calibrate_camera(nothing, eye, surface) is eye
