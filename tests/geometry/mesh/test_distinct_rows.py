"""Distinct rows against numpy's own, which sorts whole rows."""

import numpy as np
import pytest

from tableverse_factory.geometry.mesh.distinct_rows import find_distinct_rows


@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (500, 1), (2000, 6)])
def test_rows_order_and_places_are_those_of_numpy(shape):
    rows = np.random.default_rng(4).integers(-1, 2, shape) * np.where(np.arange(shape[1]) % 2, -0.0, 0.5)
    distinct, index = find_distinct_rows(rows)
    expected, expected_index = np.unique(rows, axis=0, return_inverse=True)
    np.testing.assert_array_equal(distinct, expected)
    np.testing.assert_array_equal(index, expected_index.reshape(-1))
    np.testing.assert_array_equal(distinct[index], rows)
