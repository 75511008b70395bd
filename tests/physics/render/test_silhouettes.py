"""Silhouettes against masks, counted by hand."""

import numpy as np
import pytest

from tableverse_factory.physics.render.silhouettes import compare_silhouettes


def ids(*rows):
    return np.array(rows, dtype=np.int32)


def test_overlaps_are_as_counted_by_hand():
    found = compare_silhouettes(ids([1, 1, 1, 0], [2, 2, 0, -1]), ids([0, 1, 1, 1], [2, 1, 0, 3]))
    assert found.ious == pytest.approx({1: 2 / 5, 2: 1 / 2, 3: 0.0})
    assert found.whole_iou == pytest.approx(3 / 7)


def test_the_same_image_agrees_wholly():
    image = ids([0, 4, 4], [7, 4, -1])
    found = compare_silhouettes(image, image)
    assert (found.ious, found.whole_iou) == ({4: 1.0, 7: 1.0}, 1.0)


def test_an_object_that_is_not_shown_takes_its_pixels_from_the_whole():
    masks = ids([1, 1, 1, 2])
    assert compare_silhouettes(masks, ids([1, 1, 1, 0])).whole_iou == pytest.approx(3 / 4)
    assert compare_silhouettes(masks, ids([0, 0, 0, 2])).whole_iou == pytest.approx(1 / 4)
