"""The detector and box segmenter `picture`: objects and table-top from colour, by the net of this package."""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from schemas.config import Config
from schemas.geometry import TABLE_ID, IdImage, Mask
from schemas.observation import Observation
from tableverse_factory.models.picture.instances import (
    SURELY_OTHER,
    label_standing_parts,
    segment_prediction,
    upsample_ids,
)
from tableverse_factory.models.picture.predict import (
    OBJECT,
    OTHER,
    TABLE,
    PicturePrediction,
    predict_picture,
    predict_window,
)
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.interfaces import DetectionResult
from tableverse_factory.stages.perceive.base.object_filter import (
    keep_objects,
    renumber_regions,
)
from tableverse_factory.stages.perceive.base.table_view import TableView, expand_window
from tableverse_factory.stages.perceive.depth_segmenter.rims import find_rims
from tableverse_factory.stages.perceive.depth_segmenter.segment import (
    assign_regions_to_boxes,
    fill_holes,
    to_detections,
)
from tableverse_factory.stages.perceive.depth_segmenter.vessels import find_containers

MARGIN_SHARE = 0.05  # of the picture's length, on each side of what rises
SPECK_PX = 2  # half the width of the holes that every sensor has between readings


def detect_in_picture(view: TableView, config: Config, _services: Services) -> DetectionResult:
    """Detect the objects that the net sees on the table as unnamed candidates, the largest first."""
    return detect_predicted(view, predict_view(view, config.perceive.detector_weights))


def detect_predicted(view: TableView, found: PicturePrediction) -> DetectionResult:
    """Detect the objects that the net has `found`, as `detect_in_picture`."""
    found = label_standing_parts(found) if view.observation.bend else found
    regions = keep_objects(segment_prediction(found, view.valid.shape), view, by_depth=False)
    sizes = np.bincount(regions.ravel())[1:]
    regions = fill_holes(renumber_regions(regions, [int(k) + 1 for k in np.argsort(-sizes, kind="stable")]))
    detections = to_detections(regions, find_containers(regions, find_rims(regions, view), view))
    return replace(detections, shown=find_standing(view, found))


def find_standing(view: TableView, found: PicturePrediction) -> Mask:
    """Find where objects are seen, found or not.

    A sensor tells what rises over the table, and the net what of that is none: people's arms, and what stands behind.
    """
    shape = view.valid.shape
    if view.observation.bend:
        return find_label(found, OBJECT, shape)
    other = upsample_ids((found.label[OTHER] > SURELY_OTHER).astype(np.int32), shape) > 0
    return view.raised & (view.observation.depth > 0) & ~other


def segment_boxes_in_picture(view: TableView, found: DetectionResult, config: Config) -> IdImage:
    """Assign the objects and the table-top that the net sees to the boxes of a detector."""
    seen = predict_observation(view.observation, config.perceive.segmenter_weights)
    ids = assign_regions_to_boxes(segment_prediction(seen, view.valid.shape), found)
    return np.where((ids == 0) & find_label(seen, TABLE, view.valid.shape), TABLE_ID, ids)


def find_table_top(item: Observation, weights: str) -> Mask:
    """Find the pixels of the table-top. Shape (h, w)."""
    return find_label(predict_observation(item, weights), TABLE, item.depth.shape)


def predict_view(view: TableView, weights: str) -> PicturePrediction:
    """Ask the net; with a sensor, about the part where objects may be alone, so that small ones have more pixels.

    They may be where something rises, and where the table has holes: a sensor reads nothing on glass.
    """
    item = view.observation
    unread = ndimage.binary_fill_holes(view.on_plane | view.raised) & ~view.valid
    possible = view.raised | ndimage.binary_opening(unread, iterations=SPECK_PX)
    if item.bend or not possible.any():
        return predict_observation(item, weights)
    margin = round(MARGIN_SHARE * max(item.depth.shape))
    return predict_window(item.color, item.camera, item.depth, expand_window(possible, margin), weights)


def predict_observation(item: Observation, weights: str) -> PicturePrediction:
    """Ask the net, which also reads the depth of a sensor; that of a model would tell it nothing new."""
    return predict_picture(item.color, item.camera, None if item.bend else item.depth, weights)


def find_label(found: PicturePrediction, label: int, shape: tuple[int, int]) -> Mask:
    """Find the pixels of the picture, of `shape` (h, w), for which a label is the most probable."""
    return upsample_ids((found.label.argmax(axis=0) == label).astype(np.int32), shape) > 0
