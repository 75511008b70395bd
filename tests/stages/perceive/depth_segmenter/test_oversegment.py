"""Attachment of border pixels to regions."""

import numpy as np

from schemas.geometry import Camera
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.stages.perceive.depth_segmenter.oversegment import attach_border_pixels
from tableverse_factory.stages.perceive.depth_segmenter.surface import (
    Surface,
)


def test_leftover_pixels_go_over_the_smallest_jump():
    depth = np.full((20, 40), 0.8)
    depth[:, 24:] = 0.81
    camera = Camera(200.0, 200.0, 19.5, 9.5, 40, 20)
    points = backproject(depth, camera)
    surface = Surface(points, np.zeros_like(points), np.zeros(depth.shape))
    ids = np.zeros(depth.shape, dtype=np.int32)
    ids[:, :15], ids[:, 30:] = 7, 3
    found = attach_border_pixels(ids, surface, np.ones(depth.shape, dtype=bool), 50)
    assert len(np.unique(found)) == 2
    assert (found[:, :24] == found[0, 0]).all()
    assert (found[:, 24:] == found[0, -1]).all()


def test_what_no_way_reaches_stays_apart_or_goes():
    depth = np.full((20, 40), 0.8)
    depth[:, 30:] = 1.2
    points = backproject(depth, Camera(200.0, 200.0, 19.5, 9.5, 40, 20))
    surface = Surface(points, np.zeros_like(points), np.zeros(depth.shape))
    ids = np.zeros(depth.shape, dtype=np.int32)
    ids[:, :15] = 1
    mask = np.ones(depth.shape, dtype=bool)
    assert len(np.unique(attach_border_pixels(ids, surface, mask, 150))) == 2
    assert not attach_border_pixels(ids, surface, mask, 250)[:, 30:].any()
