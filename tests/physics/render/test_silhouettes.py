"""Silhouettes against masks, counted by hand."""

import numpy as np
import pytest

from schemas.geometry import Camera, Pose
from schemas.scene import Coverage
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.physics.render.render import look_at, render
from tableverse_factory.physics.render.silhouettes import compare_silhouettes, measure_coverage
from tests.helpers.simple_scenes import box


def ids(*rows):
    return np.array(rows, dtype=np.int32)


def test_overlaps_are_as_counted_by_hand():
    found = compare_silhouettes(ids([1, 1, 1, 0], [2, 2, 0, -1]), ids([0, 1, 1, 1], [2, 1, 0, 3]))
    assert found == pytest.approx({1: 2 / 5, 2: 1 / 2, 3: 0.0})


def test_the_same_image_agrees_wholly():
    image = ids([0, 4, 4], [7, 4, -1])
    assert compare_silhouettes(image, image) == {4: 1.0, 7: 1.0}


CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
EYE = look_at(np.array([0.0, -0.6, 0.6]), np.zeros(3))
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
BOXES = [place_mesh(box(0.1, 0.1, 0.1), Pose(np.array([x, 0.0, 0.05]), UPRIGHT)) for x in (-0.12, 0.12)]


def masks_of(meshes, camera=CAMERA):
    return render(meshes, camera, EYE, shadows=False).ids + 1


def test_a_twin_covers_its_own_masks():
    assert measure_coverage(masks_of(BOXES), [1, 2], BOXES, CAMERA, EYE) == Coverage(1.0, (1.0, 1.0))


def test_a_twin_with_one_object_removed_covers_less_of_the_whole():
    found = measure_coverage(masks_of(BOXES), [1], BOXES[:1], CAMERA, EYE)
    assert found.of_objects == (1.0,)
    assert found.whole == pytest.approx(0.5, abs=0.02)


def test_an_object_behind_another_does_not_cover_its_mask():
    nearer = place_mesh(BOXES[0], Pose(np.array([0.0, -0.2, 0.1]), UPRIGHT))
    found = measure_coverage(masks_of(BOXES), [1, 2, None], [*BOXES, nearer], CAMERA, EYE)
    assert found.of_objects[0] < 0.8
    assert found.of_objects[1:] == (1.0, None)


def test_large_pictures_are_thinned_and_cover_the_same():
    large = Camera(1500.0, 1500.0, 799.5, 599.5, 1600, 1200)
    moved = [BOXES[0], place_mesh(BOXES[1], Pose(np.array([0.03, 0.0, 0.0]), UPRIGHT))]
    small = measure_coverage(masks_of(BOXES), [1, 2], moved, CAMERA, EYE)
    assert measure_coverage(masks_of(BOXES, large), [1, 2], moved, large, EYE).whole == pytest.approx(
        small.whole, abs=0.01
    )
