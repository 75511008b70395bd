"""Tilt and displacement between the picture and the end, known on paper."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.geometry import Pose
from schemas.objects import PlacedObject
from tableverse_factory.geometry.math.transforms import multiply_quaternions, quaternion_from_rotation_vector
from tableverse_factory.geometry.relations.displacement import Displacement, measure_displacement
from tests.helpers.simple_scenes import box

ITEM = PlacedObject(
    "obj_000",
    "box",
    1.0,
    box(0.1, 0.06, 0.2),
    2.0,
    Pose(np.array([0.1, 0.2, 0.2]), quaternion_from_rotation_vector(np.array([0.2, -0.3, 0.7]))),
)


def turned(vector, shift=(0.0, 0.0, 0.0)):
    turn = quaternion_from_rotation_vector(np.array(vector))
    return Pose(ITEM.pose.position + np.array(shift), multiply_quaternions(turn, ITEM.pose.quaternion_wxyz))


def test_what_stays_has_no_displacement():
    assert measure_displacement(ITEM, ITEM.pose) == Displacement(0.0, pytest.approx(0.0, abs=1e-7))
    assert measure_displacement(ITEM, ITEM.pose).kind == ""


def test_a_turn_about_the_vertical_is_no_tilt():
    assert measure_displacement(ITEM, turned((0.0, 0.0, 2.5))).tilt_rad == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("angle", [0.1, 0.9, 1.6, 3.0])
def test_a_turn_about_a_level_axis_is_its_angle(angle):
    axis = np.array([np.cos(0.4), np.sin(0.4), 0.0])
    found = measure_displacement(ITEM, turned(angle * axis))
    assert found.tilt_rad == pytest.approx(angle, abs=1e-6)
    assert found.kind == ("toppled" if angle > 0.6 else "")


def test_a_shift_is_that_of_the_middle_and_slides_beyond_four_centimetres():
    near, far = (measure_displacement(ITEM, turned((0.0, 0.0, 0.0), (x, 0.0, 0.0))) for x in (0.03, 0.05))
    assert (near.distance_m, far.distance_m) == (pytest.approx(0.03), pytest.approx(0.05))
    assert (near.kind, far.kind) == ("", "slid")


def test_a_copy_was_never_placed_by_the_picture():
    assert measure_displacement(replace(ITEM, copy_of="obj_007"), ITEM.pose) is None
