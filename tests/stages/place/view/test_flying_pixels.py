"""False readings along an outline: what colour and slope give away, and what they must leave alone."""

import numpy as np
import pytest

from schemas.geometry import Camera
from tableverse_factory.stages.place.view.flying_pixels import (
    find_background_colors,
    find_depth_ramps,
    find_flying_pixels,
)
from tableverse_factory.stages.place.view.object_pixels import NEAR, compute_color_share, find_foreign_colors

RED, WOOD, BLACK = (190, 40, 45), (150, 115, 80), (12, 12, 14)
PALE_WOOD = (164, 128, 93)  # within what counts as the table's colour, but with an edge
CAMERA = Camera(300.0, 300.0, 40.0, 30.0, 80, 60)


def picture(**patches):
    """A wooden table 1 m away; the object, red, fills rows 20 to 40 and columns 20 to 60, 0.8 m away."""
    color = np.full((60, 80, 3), WOOD, dtype=np.uint8)
    depth = np.full((60, 80), 1.0)
    own = np.zeros((60, 80), dtype=bool)
    own[20:40, 20:60] = True
    color[own], depth[own] = RED, 0.8
    for rows, columns, paint, meters in patches.values():
        color[rows, columns], depth[rows, columns] = paint, meters
    return color, depth, own


@pytest.mark.parametrize("paint", [BLACK, WOOD])
def test_a_lost_reading_of_a_foreign_colour_lies_past_the_object(paint):
    lost = (slice(20, 40), slice(60, 66), paint, 0.0)
    color, depth, own = picture(lost=lost)
    asked = depth == 0.0
    assert find_foreign_colors(color, own, ~own & ~asked, asked)[asked].all()


def test_a_lost_reading_of_the_objects_colour_may_be_the_object():
    color, depth, own = picture(lost=(slice(20, 40), slice(60, 66), RED, 0.0))
    asked = depth == 0.0
    assert not find_foreign_colors(color, own, ~own & ~asked, asked).any()


def test_a_patch_of_the_table_that_the_mask_took_along_is_not_the_object():
    ramp = np.linspace(0.8, 1.0, 14)[None, :]
    color, depth, own = picture(patch=(slice(24, 36), slice(60, 74), WOOD, ramp))
    own[24:36, 60:74] = True
    found = find_flying_pixels(find_background_colors(color, own, ~own), color, depth, own, ~own, measured=True)
    assert found[24:36, 61:73].mean() > 0.7
    assert not found[:, :60].any()


def test_a_wide_patch_that_stands_out_in_depth_but_not_in_the_picture_is_not_the_object():
    """As gloss makes them: the filter of a sensor fills what it could not read with the object's depth."""
    color, depth, own = picture(patch=(slice(12, 20), slice(20, 60), WOOD, 0.8))
    own[12:20, 20:60] = True
    found = find_flying_pixels(find_background_colors(color, own, ~own), color, depth, own, ~own, measured=True)
    assert found[13:19, 22:58].mean() > 0.95
    assert not found[21:].any()


def test_only_measured_depth_is_smeared_so_widely():
    color, depth, own = picture(patch=(slice(12, 20), slice(20, 60), WOOD, 0.8))
    own[12:20, 20:60] = True
    background = find_background_colors(color, own, ~own)
    assert not find_flying_pixels(background, color, depth, own, ~own, measured=False)[17:19, 24:56].any()


def test_a_lid_much_like_the_table_that_the_picture_shows_to_end_stays():
    color, depth, own = picture(lid=(slice(12, 20), slice(20, 60), PALE_WOOD, 0.8))
    own[12:20, 20:60] = True
    background = find_background_colors(color, own, ~own)
    assert background[13:19, 22:58].all()
    found = find_flying_pixels(background, color, depth, own, ~own, measured=True)
    assert not found[17:19, 24:56].any(), "only a rim may go"


def test_where_hue_tells_nothing_nothing_is_taken():
    color, depth, own = picture()
    color[:] = 170
    color[own] = 210
    color[20:40, 50:60] = 172
    assert not find_flying_pixels(
        find_background_colors(color, own, ~own), color, depth, own, ~own, measured=True
    ).any()


def test_a_ramp_to_what_lies_behind_is_found_and_a_face_is_not():
    _, depth, own = picture()
    depth[20:40, 52:60] = np.linspace(0.83, 1.0, 8)
    found = find_depth_ramps(depth, own, own, CAMERA)
    assert found[22:38, 54:59].mean() > 0.8
    assert not found[22:38, 22:48].any()
    depth[20:40, 52:60] = 0.8 + 0.0012 * np.arange(8)
    assert not find_depth_ramps(depth, own, own, CAMERA)[22:38].any()


def test_shares_of_alike_colours_are_those_of_all_pairs():
    rng = np.random.default_rng(5)
    colors, known = rng.uniform(-40.0, 40.0, (700, 3)), rng.uniform(-40.0, 40.0, (350, 3))
    alike = np.linalg.norm(colors[:, None] - known, axis=2) <= NEAR
    assert alike.any()
    np.testing.assert_array_equal(compute_color_share(colors, known), alike.mean(axis=1))
    assert compute_color_share(colors[:0], known).shape == (0,)
    np.testing.assert_array_equal(compute_color_share(colors, known[:0]), np.zeros(700))
