"""Outlier filters on the points of one object."""

import numpy as np

from tableverse_factory.stages.perceive.perceive import find_inlier_points


def test_stray_points_go_and_the_surface_stays():
    rng = np.random.default_rng(0)
    surface = np.column_stack([rng.uniform(0, 0.1, (2000, 2)), rng.normal(0, 0.0005, 2000)])
    stray = rng.uniform(0.15, 0.4, (30, 3))
    kept = find_inlier_points(np.vstack([surface, stray]))
    assert not kept[2000:].any()
    assert kept[:2000].mean() > 0.9
    assert not find_inlier_points(surface[:10]).any(), "ten points are no object"


def test_cleaning_does_not_depend_on_where_or_how_large():
    rng = np.random.default_rng(1)
    points = np.vstack([rng.uniform(0, 0.1, (500, 3)), rng.uniform(0.3, 0.5, (5, 3))])
    np.testing.assert_array_equal(find_inlier_points(points), find_inlier_points(points * 4.0 + [1.0, -2.0, 3.0]))
