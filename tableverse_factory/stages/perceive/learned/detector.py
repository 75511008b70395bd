"""The detector `learned`: a small network, trained on synthetic depth, groups pixels into objects.

Segmenting unseen objects by votes for their centres, learned from synthetic depth, follows UOIS-Net-3D (Xie, Xiang,
Mousavian and Fox, 2021); network, training and clustering differ.
"""

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from schemas.config import Config
from schemas.geometry import IdImage, Mask, Points
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.interfaces import DetectionResult
from tableverse_factory.stages.perceive.base.object_filter import (
    keep_objects,
    keep_regions_over_table,
    renumber_regions,
)
from tableverse_factory.stages.perceive.base.table_view import ImageWindow, TableView, crop_view
from tableverse_factory.stages.perceive.depth_segmenter.rims import find_rims
from tableverse_factory.stages.perceive.depth_segmenter.segment import fill_holes, to_detections
from tableverse_factory.stages.perceive.depth_segmenter.vessels import find_containers
from tableverse_factory.stages.perceive.learned.features import MULTIPLE, OFFSET_UNIT_M, PIXELS, compute_features
from tableverse_factory.stages.perceive.learned.mean_shift import cluster_votes
from tableverse_factory.stages.perceive.learned.net_format import THINNING
from tableverse_factory.stages.perceive.learned.onnx import SegmentationNet, load_net

MIN_VOTES = 24
MIN_PART = 0.2
REACH_M = 0.02
LEAST_HEIGHT_M = 0.003


def detect_with_network(view: TableView, config: Config, _services: Services) -> DetectionResult:
    """Detect every object that the network's votes agree on as an unnamed candidate, the largest first."""
    return to_detections(*segment_with_network(view, load_net(config.perceive.detector_weights)))


def segment_with_network(view: TableView, net: SegmentationNet) -> tuple[IdImage, dict[int, int]]:
    """Segment the objects on the table, ids from 1, the largest first; and find the container of each that has one."""
    if not view.raised.any():
        return np.zeros(view.valid.shape, dtype=np.int32), {}
    height, width = view.valid.shape
    stride = max(1, round(float(np.sqrt(height * width / PIXELS))))
    coarse = crop_view(view, ImageWindow(0, 0, -(-height // stride), -(-width // stride), stride))
    points, ids = _vote(coarse, net)
    regions = _spread_ids(view, points, ids)
    regions = keep_objects(keep_regions_over_table(regions, view), view)
    sizes = np.bincount(regions.ravel())[1:]
    regions = fill_holes(renumber_regions(regions, [int(k) + 1 for k in np.argsort(-sizes, kind="stable")]))
    return regions, find_containers(regions, find_rims(regions, view), view)


def _vote(view: TableView, net: SegmentationNet) -> tuple[Points, IdImage]:
    """Compute the points of the network's output with a reading, and the object of each from 1, 0 for none."""
    table = _compute_table_points(view)
    center = np.median(table[view.raised][:, :2], axis=0) if view.raised.any() else np.zeros(2)
    inputs = compute_features(table, view.valid, center)
    rows, columns = (-size % MULTIPLE for size in view.valid.shape)
    output = net(np.pad(inputs, ((0, 0), (0, rows), (0, columns))))
    thin = np.s_[::THINNING, ::THINNING]
    table, valid = table[thin], view.valid[thin]
    output = output[:, : valid.shape[0], : valid.shape[1]]
    chosen = valid & (output[0] > 0.0)
    votes = table[chosen] + OFFSET_UNIT_M * np.moveaxis(output[1:], 0, -1)[chosen]
    image = np.zeros(valid.shape, dtype=np.int32)
    image[chosen] = cluster_votes(votes.astype(np.float64), MIN_VOTES) + 1
    return table[valid], _remove_crumbs(image)[valid]


def _compute_table_points(view: TableView) -> Points:
    """Compute the picture's points, x and y along the table, z above its plane [m]. Shape (h, w, 3)."""
    return np.concatenate([view.xy(view.points_camera), view.heights[..., None]], axis=-1)


def _remove_crumbs(ids: IdImage) -> IdImage:
    """Remove parts much smaller than the largest of their id: strays that voted for a distant object."""
    result = ids.copy()
    for k in range(1, int(ids.max(initial=0)) + 1):
        parts, count = ndimage.label(ids == k, np.ones((3, 3)))
        sizes = np.bincount(parts.ravel(), minlength=count + 1)
        sizes[0] = 0
        crumbs = np.flatnonzero(sizes < MIN_PART * sizes.max(initial=0))
        result[np.isin(parts, crumbs[crumbs > 0])] = 0
    return result


def _spread_ids(view: TableView, points: Points, ids: IdImage) -> IdImage:
    """Give each pixel of the picture the id of the nearest voter in space; 0 where none is near."""
    wanted: Mask = view.valid & (view.raised | (view.on_plane & (view.heights > LEAST_HEIGHT_M)))
    result = np.zeros(view.valid.shape, dtype=np.int32)
    if not len(points):
        return result
    distances, nearest = cKDTree(points).query(_compute_table_points(view)[wanted], distance_upper_bound=REACH_M)
    near = np.isfinite(distances)
    result[wanted] = np.where(near, ids[np.where(near, nearest, 0)], 0)
    return result
