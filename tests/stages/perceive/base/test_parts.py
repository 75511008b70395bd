"""The parts that segmentation is made of, each against geometry done on paper."""

import numpy as np
import pytest

from schemas.geometry import Camera
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.stages.perceive.base.table_view import (
    ImageWindow,
    compute_depth_noise,
    fill_depth_gaps,
    find_working_window,
    uncrop_ids,
)
from tableverse_factory.stages.perceive.denoise import find_inlier_points
from tableverse_factory.stages.perceive.depth_segmenter.oversegment import attach_border_pixels
from tableverse_factory.stages.perceive.depth_segmenter.segment import fill_holes
from tableverse_factory.stages.perceive.depth_segmenter.surface import (
    Surface,
    compute_surface,
    fit_normals,
    shift_image,
)

CAMERA = Camera(200.0, 200.0, 59.5, 39.5, 120, 80)


def plane_depth(normal, offset, camera=CAMERA):
    """Depth of the plane `normal · x = offset`."""
    v, u = np.indices((camera.height, camera.width), dtype=np.float64)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    return offset / (rays @ np.asarray(normal, dtype=float))


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.3, 0.2, 1), (0, 1, 0.8)])
def test_normals_of_a_plane_are_exact_up_to_the_border(normal):
    unit = -np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    depth = plane_depth(normal, 0.8)
    assert depth.min() > 0
    normals = fit_normals(depth, CAMERA, 4, np.full(depth.shape, 1.0))
    np.testing.assert_allclose(normals, np.broadcast_to(unit, normals.shape), atol=1e-4)


def two_planes(first, second, keep):
    a, b = plane_depth(*first), plane_depth(*second)
    return keep(a, b).astype(np.float32)


def test_concave_creases_and_steps_are_borders_and_convex_edges_are_not():
    roof = ((0.8, 0, 1), 0.8), ((-0.8, 0, 1), 0.8)
    middle = (slice(20, 60), slice(57, 63))
    edge = compute_surface(two_planes(*roof, np.maximum), CAMERA, 0.8).borders[middle]
    crease = compute_surface(two_planes(*roof, np.minimum), CAMERA, 0.8).borders[middle]
    if edge.max() > crease.max():
        edge, crease = crease, edge
    assert edge.max() < 0.4
    assert crease.max(axis=1).min() > 1.0
    step = np.where(np.arange(120) < 60, 0.8, 0.85) * np.ones((80, 1))
    borders = compute_surface(step.astype(np.float32), CAMERA, 0.8).borders
    assert borders[20:60, 58:62].max(axis=1).min() > 1.0
    assert borders[20:60, :50].max() < 0.1


def test_a_convex_edge_seen_from_outside_bulges_towards_the_camera():
    near = two_planes(((0.8, 0, 1), 0.8), ((-0.8, 0, 1), 0.8), np.maximum)
    assert near[40, 60] < near[40, 20], "the edge in the middle is nearer than the sides"
    assert compute_surface(near, CAMERA, 0.8).borders[20:60, 20:100].max() < 0.4


def test_shifting_looks_ahead_and_fills_with_zero():
    image = np.arange(12).reshape(3, 4)
    assert shift_image(image, 1, -1).tolist() == [[0, 4, 5, 6], [0, 8, 9, 10], [0, 0, 0, 0]]
    assert not shift_image(image, 5, 0).any()


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


def test_small_holes_close_only_within_one_object():
    ids = np.ones((30, 30), dtype=np.int32)
    ids[:, 15:] = 2
    ids[5:8, 5:8] = 0
    ids[20:22, 14:16] = 0
    ids[10:20, 20:29] = 0
    closed = fill_holes(ids)
    assert (closed[5:8, 5:8] == 1).all()
    assert (closed[20:22, 14:16] == 0).all(), "between two objects"
    assert (closed[10:20, 20:29] == 0).all(), "too large for a lost reading"


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
