"""Planes and outlines against geometry done on paper."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tableverse_factory.geometry.math.planes import (
    Plane,
    compute_convex_outline,
    find_dominant_planes,
    fit_min_rectangle,
    fit_plane,
    is_inside_outline,
    measure_depth_inside,
    refine_plane,
)

angles = st.floats(-3.0, 3.0)


def points_on(normal, offset, rng, count=300, size=1.0):
    """Points of the plane `normal · x = offset`, spread over about `size`."""
    normal = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    free = rng.uniform(-size, size, (count, 3))
    return free - (free @ normal - offset)[:, None] * normal, normal


@settings(deadline=None, max_examples=40)
@given(st.tuples(angles, angles, angles).filter(lambda n: np.linalg.norm(n) > 0.1), st.floats(-5, 5))
def test_a_plane_is_recovered_from_its_points(normal, offset):
    points, unit = points_on(normal, offset, np.random.default_rng(0))
    plane = fit_plane(points).facing(unit * (offset + 1.0))
    np.testing.assert_allclose(plane.normal, unit, atol=1e-9)
    assert plane.offset == pytest.approx(offset, abs=1e-9)
    np.testing.assert_allclose(plane.heights(points), 0.0, atol=1e-9)


def test_heights_are_signed_distances_and_facing_turns_the_normal():
    plane = Plane(np.array([0.0, 0.0, 1.0]), 2.0)
    assert plane.heights(np.array([7.0, -3.0, 5.0])) == pytest.approx(3.0)
    below = plane.facing(np.zeros(3))
    np.testing.assert_allclose(below.normal, [0, 0, -1])
    assert below.heights(np.zeros(3)) == pytest.approx(2.0)


def test_least_squares_beats_any_tilted_neighbour():
    rng = np.random.default_rng(1)
    points, _ = points_on([0.2, 0.1, 1.0], 0.3, rng)
    points = points + rng.normal(0, 0.01, points.shape)
    best = fit_plane(points)
    cost = np.sum(best.heights(points) ** 2)
    for _ in range(50):
        normal = best.normal + rng.normal(0, 1e-3, 3)
        normal /= np.linalg.norm(normal)
        other = Plane(normal, float(normal @ points.mean(axis=0)))
        assert np.sum(other.heights(points) ** 2) >= cost - 1e-12


def test_two_points_are_no_plane():
    with pytest.raises(ValueError, match="2 points"):
        fit_plane(np.zeros((2, 3)))


def test_outliers_do_not_tilt_a_refined_plane():
    rng = np.random.default_rng(2)
    inliers, normal = points_on([0, 0, 1], 0.0, rng, 500)
    outliers = rng.uniform(0.05, 0.5, (200, 3))
    points = np.vstack([inliers, outliers])
    found = refine_plane(Plane(np.array([0.0, 0.02, 1.0]), 0.0), points, np.full(700, 0.03))
    assert abs(float(found.normal @ normal)) > 1 - 1e-6


def test_planes_come_in_the_order_of_their_points_and_small_ones_are_hit():
    rng = np.random.default_rng(3)
    large, _ = points_on([0, 0, 1], 0.0, rng, 3000)
    middle, _ = points_on([1, 0, 0], 2.0, rng, 800)
    small, _ = points_on([0, 1, 1], 4.0, rng, 200, size=0.1)
    clutter = 5.0 + rng.uniform(-1, 1, (400, 3))
    points = np.vstack([large, middle, small, clutter])
    tolerance = np.full(len(points), 1e-6)
    found = list(find_dominant_planes(points, tolerance, np.random.default_rng(0), max_planes=4, min_inliers=100))
    assert [int(inliers.sum()) for _, inliers in found] == [3000, 800, 200]
    assert not (found[0][1] & found[1][1]).any(), "a point belongs to one plane"


def test_the_same_generator_gives_the_same_planes():
    points = np.random.default_rng(4).normal(size=(500, 3))
    tolerance = np.full(500, 0.1)
    first, second = (
        [p.normal.tobytes() for p, _ in find_dominant_planes(points, tolerance, np.random.default_rng(9), 3, 10)]
        for _ in range(2)
    )
    assert first == second


@settings(deadline=None, max_examples=40)
@given(st.floats(-0.78, 0.78), st.floats(0.05, 2), st.floats(0.05, 2), st.floats(-3, 3), st.floats(-3, 3))
def test_the_rectangle_of_a_rectangle_is_itself(yaw, half_x, half_y, x, y):
    axes = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    inner = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    local = np.vstack([inner, [[-1, -1], [-1, 1], [1, -1], [1, 1]]]) * [half_x, half_y]
    found = fit_min_rectangle(local @ axes.T + [x, y])
    np.testing.assert_allclose(found.center, [x, y], atol=1e-9)
    assert np.prod(found.half_size) == pytest.approx(half_x * half_y, rel=1e-9)
    assert abs(np.sin(2 * (found.yaw - yaw))) < 1e-6, "the axes agree up to a quarter turn"


def test_points_on_a_line_still_have_an_outline_and_a_rectangle():
    points = np.stack([np.linspace(0, 1, 5), np.zeros(5)], axis=1)
    assert is_inside_outline(compute_convex_outline(points), points).all()
    np.testing.assert_array_equal(compute_convex_outline(points, 0.0).max(axis=0), [1.0, 0.0])
    assert fit_min_rectangle(compute_convex_outline(points[:1])).half_size.max() < 0.01


def test_depth_inside_a_square():
    square = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])
    grid = np.array([[[1.0, 1.0], [0.25, 1.0]], [[-0.5, 1.0], [1.0, 2.1]]])
    np.testing.assert_allclose(measure_depth_inside(square, grid), [[1.0, 0.25], [-0.5, -0.1]], atol=1e-12)
    assert is_inside_outline(square, grid, 0.2).tolist() == [[True, True], [False, True]]
    assert is_inside_outline(square, grid, -0.5).tolist() == [[True, False], [False, False]]
