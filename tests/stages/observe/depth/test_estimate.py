"""Depth of a model's resolution comes back to the picture's: right on surfaces, and never hanging between two."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy import ndimage

from schemas.config import ObserveConfig
from schemas.geometry import Camera
from tableverse_factory.core.errors import InputError
from tableverse_factory.geometry.math.camera import backproject, project, rescale_camera
from tableverse_factory.stages.observe.depth.estimate import (
    DepthEstimate,
    build_capture,
    parse_intrinsics,
)
from tableverse_factory.stages.observe.depth.resample import find_step_pixels, resample_depth
from tests.helpers.tabletop_views import Box, camera_above, look

THINGS = (Box(-0.12, 0.05, (0.1, 0.06, 0.15)), Box(0.15, -0.05, (0.08, 0.08, 0.08)))
SIZES = st.integers(9, 40)


def as_seen_by_a_model(depth, width=504, height=378):
    """Steps smeared over some pixels, as networks do."""
    small = np.array(Image.fromarray(depth).resize((width, height), Image.Resampling.BOX))
    return ndimage.gaussian_filter(small, 0.7)


def share_in_the_air(depth, truth):
    """Of the readings, how many lie on nothing that is near them in the picture."""
    known = depth > 0
    nearest = np.full(truth.shape, np.inf)
    for rows in range(-3, 4):
        for columns in range(-3, 4):
            there = np.roll(truth, (rows, columns), (0, 1))
            nearest = np.minimum(nearest, np.abs(depth - there))
    return float((nearest > 0.015)[known].mean())


@pytest.mark.heavy
def test_no_reading_hangs_between_an_object_and_what_lies_behind_it():
    observation, _ = look(THINGS, camera_above(0.6, 0.8, 35.0))
    truth = observation.depth.astype(np.float32)
    small = as_seen_by_a_model(truth)
    plainly = np.array(Image.fromarray(small).resize((640, 480), Image.Resampling.BILINEAR))
    ours = resample_depth(small, 640, 480)
    assert share_in_the_air(plainly, truth) > 0.005
    assert share_in_the_air(ours, truth) < 0.1 * share_in_the_air(plainly, truth)
    assert (ours > 0).mean() > 0.97 * (truth > 0).mean()
    on_surface = (ours > 0) & (ndimage.maximum_filter(truth, 9) - ndimage.minimum_filter(truth, 9) < 0.05)
    assert np.median(np.abs(ours - truth)[on_surface]) < 2e-4


@pytest.mark.heavy
@given(SIZES, SIZES, SIZES, SIZES, st.floats(-0.002, 0.002), st.floats(-0.002, 0.002))
def test_a_slanted_plane_comes_back_as_itself(rows, columns, height, width, down, right):
    def plane(h, w):
        v, u = (np.arange(n) + 0.5 for n in (h, w))
        return (1.0 + down * 40 * v[:, None] / h + right * 40 * u[None, :] / w).astype(np.float32)

    back = resample_depth(plane(rows, columns), width, height)
    inside = (slice(height // rows + 1, -height // rows - 1), slice(width // columns + 1, -width // columns - 1))
    np.testing.assert_allclose(back[inside], plane(height, width)[inside], atol=1e-5)
    assert back.shape == (height, width)
    assert (back > 0).all()


@given(st.integers(0, 2**32 - 1), SIZES, SIZES)
def test_what_comes_back_is_a_reading_or_lies_between_readings_of_one_surface(seed, height, width):
    rng = np.random.default_rng(seed)
    depth = rng.choice([0.0, 0.5, 0.505, 1.0, 1.02, 3.0], (12, 14)).astype(np.float32)
    back = resample_depth(depth, width, height)
    surfaces = [(0.5, 0.505), (1.0, 1.02), (3.0, 3.0)]
    assert all(value == 0 or any(low - 1e-6 <= value <= high + 1e-6 for low, high in surfaces) for value in back.flat)


def test_a_clean_step_keeps_both_its_sides():
    depth = np.where(np.arange(20) < 10, 0.5, 1.0)[None, :].repeat(16, axis=0)
    assert not find_step_pixels(depth).any()
    smeared = depth.copy()
    smeared[:, 9], smeared[:, 10] = 0.68, 0.82
    assert find_step_pixels(smeared)[:, 9:11].all()
    assert not find_step_pixels(smeared)[:, :8].any()


@given(st.floats(100, 4000), st.integers(20, 3000), st.integers(20, 3000))
def test_a_point_keeps_its_direction_at_any_size(focal, width, height):
    camera = Camera(focal, 1.1 * focal, 0.4 * width, 0.6 * height, width, height)
    other = rescale_camera(camera, 504, 378)
    ray = np.array([[0.1, -0.05, 1.0]])
    u, v = project(ray, camera)[0]
    np.testing.assert_allclose(
        project(ray, other)[0], [(u + 0.5) * 504 / width - 0.5, (v + 0.5) * 378 / height - 0.5], atol=1e-6
    )
    back = rescale_camera(other, width, height)
    np.testing.assert_allclose([back.fx, back.fy, back.cx, back.cy], [camera.fx, camera.fy, camera.cx, camera.cy])


@pytest.mark.parametrize("wrong", [{"fx": 0.0}, {"fy": np.nan}, {"cx": -50.0}, {"cy": 1e9}, {"fx": -300.0}], ids=str)
def test_what_is_no_camera_is_refused(wrong):
    said = {"fx": 400.0, "fy": 400.0, "cx": 252.0, "cy": 189.0} | wrong
    matrix = np.array([[said["fx"], 0, said["cx"]], [0, said["fy"], said["cy"]], [0, 0, 1]])
    with pytest.raises(InputError) as refused:
        parse_intrinsics(matrix, 504, 378)
    assert refused.value.reason == "bad_intrinsics"


def test_nothing_is_believed_beyond_the_bound_and_nothing_left_is_a_reason():
    color = np.zeros((48, 64, 3), np.uint8)
    depth = np.full((12, 16), 1.0, np.float32)
    depth[:, 8:] = 7.0
    depth[0, 0], depth[0, 1], depth[0, 2] = np.nan, np.inf, -1.0
    estimate = DepthEstimate(depth, Camera(10.0, 10.0, 7.5, 5.5, 16, 12))
    found = build_capture(color, estimate, ObserveConfig())
    assert found.depth.shape == (48, 64)
    assert set(np.unique(found.depth)) == {np.float32(0.0), np.float32(1.0)}
    assert found.camera == Camera(40.0, 40.0, 31.5, 23.5, 64, 48)
    points = backproject(found.depth, found.camera)
    assert np.isfinite(points).all()
    with pytest.raises(InputError) as refused:
        build_capture(color, estimate, ObserveConfig(max_depth_m=0.5))
    assert refused.value.reason == "depth_all_zero"
    assert "0.5" in str(refused.value)
