"""Views of the table: gaps, windows and noise."""

import numpy as np
import pytest

from tableverse_factory.stages.perceive.base.table_view import (
    ImageWindow,
    compute_depth_noise,
    fill_depth_gaps,
    find_working_window,
    uncrop_ids,
)


def test_gaps_are_filled_with_a_reading_beside_them_and_wide_shadows_stay():
    depth = np.full((30, 30), 0.8, dtype=np.float32)
    depth[:, 15:] = 1.2
    gap = depth.copy()
    gap[10, 5], gap[5:20, 15], gap[22:29, 2:9] = 0.0, 0.0, 0.0
    filled = fill_depth_gaps(gap)
    assert filled[10, 5] == np.float32(0.8)
    assert set(np.unique(filled[5:20, 15])) <= {np.float32(0.8), np.float32(1.2)}, "never a mean over the step"
    assert filled[25, 5] == 0.0
    np.testing.assert_array_equal(filled[gap > 0], gap[gap > 0])


@pytest.mark.parametrize("max_pixels", [10**6, 3000, 700])
def test_a_window_covers_the_mask_and_goes_back_where_it_came_from(max_pixels):
    mask = np.zeros((75, 101), dtype=bool)
    mask[40:70, 90:101] = True
    window = find_working_window(mask, max_pixels, margin=2)
    part = mask[window.slices]
    assert part.shape == (window.height, window.width)
    back = uncrop_ids(part.astype(np.int32), window, mask.shape)
    assert back.shape == mask.shape
    if window.stride == 1:
        np.testing.assert_array_equal(back > 0, mask)
    assert (back > 0)[mask].mean() > 0.85
    assert back[:30].sum() == 0


def test_windows_are_slices_of_the_picture():
    window = ImageWindow(4, 6, 3, 2, 2)
    assert window.slices == (slice(4, 10, 2), slice(6, 10, 2))


def test_noise_grows_with_distance():
    noise = compute_depth_noise(np.array([0.4, 0.8, 1.6, 3.2]))
    assert (np.diff(noise) > 0).all()
    assert noise[0] == pytest.approx(0.0012)
