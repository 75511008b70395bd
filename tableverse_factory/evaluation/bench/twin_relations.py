"""Support and containment of a photograph, and how much of them holds in its twin."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from schemas.geometry import IdImage, Pose
from schemas.objects import PerceivedObject
from tableverse_factory.core.cache_dir import get_cache_dir
from tableverse_factory.evaluation.methods.layout import compare_scene, find_object_relations
from tableverse_factory.evaluation.methods.sources import read_model_scene, read_pose
from tableverse_factory.evaluation.methods.truth import CAPTURE_TRUTH, load_capture_truth
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.relations.preserved import PreservedRelations, Relations, compare_relations
from tableverse_factory.physics.mjcf.load import load_model
from tableverse_factory.sources.capture import Capture
from tableverse_factory.stages.perceive.perceive import find_inlier_points
from tableverse_factory.stages.place.view.support_from_depth import find_supports

MAX_POINTS = 12_000  # of an object, as in `perceive`


def compare_twin_relations(
    folder: Path, capture: Capture, files: Mapping[str, bytes], meta: Mapping[str, Any], masks: IdImage
) -> PreservedRelations:
    """Count the relations of a photograph and those that hold in its exported scene.

    Those of the photograph are true ones where `truth.json` has them (`evaluate layout`); else containment as
    perceived, and support as the sensor's heights show it.
    """
    camera_to_table = read_pose(meta["camera_to_table"])
    scene = replace(read_model_scene(load_model(files)), camera_to_scene=camera_to_table)
    if (folder / CAPTURE_TRUTH).is_file():
        truth = load_capture_truth(folder / CAPTURE_TRUTH, scene)
        return compare_scene(folder.name, scene, truth, get_cache_dir()).kept
    seen = read_relations(capture, masks, camera_to_table, meta["objects"])
    index = {str(entry["object_id"]): number for number, entry in enumerate(meta["objects"])}
    order = [index[item.name] for item in scene.objects]
    return compare_relations(seen, find_object_relations(scene.objects, get_cache_dir()).renumbered(order))


def read_relations(
    capture: Capture, masks: IdImage, camera_to_table: Pose, entries: Sequence[Mapping[str, Any]]
) -> Relations:
    """Read the relations between the objects of meta.json, by their order, from the capture; copies have none."""
    index = {str(entry["object_id"]): number for number, entry in enumerate(entries)}
    objects = [_view_object(capture, masks, entry) for entry in entries if not entry["copy_of"]]
    supports = find_supports(objects, camera_to_table)
    inside = {item.object_id: item.contained_in for item in objects if item.contained_in in index}
    carried = {name: its.carrier for name, its in supports.items() if its.carrier is not None and name not in inside}
    on, within = (
        frozenset((index[name], index[holder]) for name, holder in pairs.items()) for pairs in (carried, inside)
    )
    return Relations(on, frozenset(), within)


def _view_object(capture: Capture, masks: IdImage, entry: Mapping[str, Any]) -> PerceivedObject:
    """View an object through its mask, with clean points as `perceive` keeps them."""
    rows, columns = np.nonzero((masks == entry["mask_value"]) & (capture.depth > 0))
    step = max(1, -(-len(rows) // MAX_POINTS))
    rows, columns = rows[::step], columns[::step]
    points = backproject(capture.depth, capture.camera)[rows, columns]
    clean = find_inlier_points(points)
    name, value = str(entry["object_id"]), int(entry["mask_value"])
    colors = capture.color[rows, columns][clean]
    return PerceivedObject(name, value, "", 1.0, points[clean], colors, contained_in=entry["placed_in"])
