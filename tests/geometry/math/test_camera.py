"""A pixel with its depth is a point, and the point is seen in that pixel."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.geometry import Camera, Pose
from tableverse_factory.geometry.math.camera import backproject, compute_field_of_view_deg, compute_pixel_rays, project
from tableverse_factory.geometry.math.transforms import transform_points

cameras = st.builds(
    Camera,
    st.floats(50, 2000),
    st.floats(50, 2000),
    st.floats(0, 30),
    st.floats(0, 20),
    st.just(32),
    st.just(24),
)


@pytest.mark.heavy
@given(cameras, st.integers(0, 2**32 - 1))
def test_pixels_come_back(camera, seed):
    depth = np.random.default_rng(seed).uniform(0.2, 5.0, (24, 32)).astype(np.float32)
    points = backproject(depth, camera)
    assert points.shape == (24, 32, 3)
    np.testing.assert_array_equal(points[..., 2], depth)
    v, u = np.indices(depth.shape)
    seen = project(points.reshape(-1, 3), camera).reshape(24, 32, 2)
    np.testing.assert_allclose(seen[..., 0], u, atol=1e-6)
    np.testing.assert_allclose(seen[..., 1], v, atol=1e-6)


def test_axes_are_those_of_opencv():
    camera = Camera(100.0, 200.0, 10.0, 5.0, 32, 24)
    point = backproject(np.full((24, 32), 2.0), camera)[15, 20]
    np.testing.assert_allclose(point, [0.2, 0.1, 2.0])  # right of and below the axis


def test_no_reading_is_the_origin_and_has_no_pixel():
    camera = Camera(100.0, 100.0, 10.0, 5.0, 32, 24)
    points = backproject(np.zeros((24, 32), np.float32), camera)
    assert not points.any()
    behind = np.array([[0.0, 0.0, 0.0], [0.1, 0.1, -1.0], [np.nan, 0.0, np.nan]])
    assert np.isnan(project(behind, camera)).all()


def test_a_far_plane_keeps_its_size():
    """The analytic truth: a 1 m wide thing at 2 m covers fx / 2 pixels."""
    camera = Camera(300.0, 300.0, 160.0, 120.0, 320, 240)
    left, right = project(np.array([[-0.5, 0.0, 2.0], [0.5, 0.0, 2.0]]), camera)[:, 0]
    assert right - left == 150.0


def test_the_field_of_view_is_the_angle_between_the_outer_borders() -> None:
    assert compute_field_of_view_deg(Camera(320.0, 300.0, 319.5, 239.5, 640, 480)) == pytest.approx(90.0)
    assert compute_field_of_view_deg(Camera(300.0, 320.0, 239.5, 319.5, 480, 640)) == pytest.approx(90.0)
    assert compute_field_of_view_deg(Camera(640.0, 640.0, -0.5, 239.5, 640, 480)) == pytest.approx(45.0)


def test_a_pixel_s_ray_goes_through_its_points() -> None:
    camera = Camera(100.0, 200.0, 10.0, 5.0, 32, 24)
    camera_to_table = Pose(np.array([0.1, -0.2, 0.3]), np.array([0.5, 0.5, -0.5, 0.5]))
    points = transform_points(camera_to_table, backproject(np.full((24, 32), 2.0), camera).reshape(-1, 3))
    rays = compute_pixel_rays(camera, camera_to_table)
    np.testing.assert_allclose(camera_to_table.position + 2.0 * rays.reshape(-1, 3), points, atol=1e-12)
    beside = compute_pixel_rays(camera, camera_to_table, (1.0, -1.0))
    np.testing.assert_allclose(beside[1:, :-1], rays[:-1, 1:], atol=1e-12)
