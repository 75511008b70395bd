"""The stage `perceive`: an observation becomes a table and the objects on it."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool
from scipy.spatial import cKDTree

from schemas.config import Config, PerceiveConfig
from schemas.geometry import TABLE_ID, Colors, IdImage, Mask, Points
from schemas.identity import make_object_id
from schemas.objects import PerceivedObject, PerceivedObjects
from schemas.observation import Observation
from schemas.outcome import Done, Dropped, Outcome
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.interfaces import Candidate, DetectionResult
from tableverse_factory.stages.perceive.base.table_view import TableView
from tableverse_factory.stages.perceive.explanation import measure_explanation
from tableverse_factory.stages.perceive.picture.detector import find_table_top
from tableverse_factory.stages.perceive.registry import BOX_SEGMENTERS, DETECTORS
from tableverse_factory.stages.perceive.scale.known_length import find_scaled_table, scale_by_height
from tableverse_factory.stages.perceive.table import compute_camera_to_table, fit_table_rectangle
from tableverse_factory.stages.perceive.table_refit import misses_table, refit_table_to_box, refit_table_to_mask

MIN_POINTS = 100
MAX_POINTS = 12_000
NEIGHBOURS = 16
DEVIATIONS = 2.0
RADIUS_OF_MEDIAN = 2.5
MIN_IN_RADIUS = 6


def perceive(
    item: Observation, config: Config, rng: np.random.Generator, services: Services
) -> Outcome[PerceivedObjects]:
    """Find the table and the objects on it; their points are denoised, in the camera frame."""
    name = choose_detector(item, config.perceive)
    table_top = find_table_top(item, config.perceive.detector_weights) if name == "picture" else None
    view = find_scaled_table(item, rng, table_top)
    if isinstance(view, Dropped):
        return view
    found = DETECTORS[name](view, config, services)
    if isinstance(found, Dropped):
        return found
    if found.table_box is not None:
        view = refit_table_to_box(view, found.table_box, rng)
    if found.table_top is not None and misses_table(view, found.table_top):
        refitted = refit_table_to_mask(view, found.table_top, rng)
        again = found if refitted is view else DETECTORS[name](refitted, config, services)
        if isinstance(again, DetectionResult) and again.candidates:
            view, found = refitted, again
    candidates, ids = found.candidates, found.ids
    if ids is None:
        ids = segment_boxes(view, found, config)
        candidates = tuple(replace(candidate, instance=k) for k, candidate in enumerate(candidates, start=1))
        view = refit_table_to_mask(view, ids == TABLE_ID, rng)
    scaled = scale_by_height(view, item, candidates, ids)
    if isinstance(scaled, Dropped):
        return scaled
    view = scaled
    objects, left_out = _build_objects(view, candidates, ids, config.perceive)
    if not objects:
        return Dropped(
            "no_objects",
            f"{len(candidates)} candidates by {name!r}, {int(view.raised.sum())} pixels above the table, "
            f"but none with {MIN_POINTS} clean points",
        )
    points = np.vstack([o.points_camera for o in objects])
    pose = compute_camera_to_table(view, points)
    table = fit_table_rectangle(view, pose, points, item.color)
    kept = _paint_ids(view, candidates, ids, objects)
    explanation = measure_explanation(view, kept, objects, found.shown)
    if why := explanation.describe_shortfall({o.object_id for o in objects}, config.perceive.min_explained):
        return Dropped("too_little_explained", why)
    seen = view.observation
    return Done(
        PerceivedObjects(item.scene_id, seen, pose, table, kept, objects, name, left_out, found.record, explanation)
    )


def choose_detector(item: Observation, config: PerceiveConfig) -> str:
    """Choose the backend; only a model's depth is bent, and that of a bare picture."""
    if config.detector not in ("auto", "ensemble"):
        return config.detector
    if config.detector == "auto" and item.recorded_detections is not None:
        return "replay"
    return "picture" if item.bend else "ensemble"


def segment_boxes(view: TableView, found: DetectionResult, config: Config) -> IdImage:
    """Segment the detector's boxes with the configured segmenter; the k-th has the id `k + 1`."""
    if not found.candidates:
        return np.zeros(view.valid.shape, dtype=np.int32)
    return BOX_SEGMENTERS[config.perceive.segmenter](view, found, config)


def _build_objects(
    view: TableView, candidates: tuple[Candidate, ...], ids: IdImage, config: PerceiveConfig
) -> tuple[tuple[PerceivedObject, ...], tuple[tuple[str, str], ...]]:
    """Build the objects with enough clean points, and the reasons against the others; ids count all candidates."""
    kept: dict[int, PerceivedObject] = {}
    left_out: list[tuple[str, str]] = []
    for index, candidate in enumerate(candidates):
        name = make_object_id(index)
        if len(kept) == config.max_objects:
            left_out.append((name, f"there are {config.max_objects} objects already (perceive.max_objects)"))
            continue
        points, colors = _clean_points(view, (ids == candidate.instance) & (ids > 0))
        if len(points) < MIN_POINTS:
            left_out.append((name, f"{candidate.label}: {len(points)} clean points; at least {MIN_POINTS} are needed"))
            continue
        label, score, count = candidate.label, candidate.score, candidate.count
        kept[index] = PerceivedObject(name, index + 1, label, score, points, colors, count=count)
    objects = tuple(
        replace(item, contained_in=kept[holder].object_id)
        if (holder := candidates[index].container) is not None and holder in kept
        else item
        for index, item in kept.items()
    )
    return objects, tuple(left_out)


def _clean_points(view: TableView, mask: Mask) -> tuple[Points, Colors]:
    """Select clean points with their colours, from measured pixels only, thinned to about `MAX_POINTS`."""
    rows, columns = np.nonzero(mask & (view.observation.depth > 0))
    step = max(1, -(-len(rows) // MAX_POINTS))
    rows, columns = rows[::step], columns[::step]
    points = view.points_camera[rows, columns]
    clean = find_inlier_points(points)
    return points[clean], view.observation.color[rows, columns][clean]


def find_inlier_points(points: Points) -> Bool[np.ndarray, " n"]:
    """Find points whose mean distance to their neighbours is usual and whose surroundings are not empty (section 3.1).

    The radius that must hold `MIN_IN_RADIUS` others follows the points' density: near and far objects count alike.
    """
    if len(points) <= NEIGHBOURS:
        return np.zeros(len(points), dtype=bool)
    distances, _ = cKDTree(points).query(points, k=NEIGHBOURS + 1)
    mean = distances[:, 1:].mean(axis=1)
    usual = mean <= mean.mean() + DEVIATIONS * mean.std()
    crowd = distances[:, MIN_IN_RADIUS]
    return usual & (crowd <= max(RADIUS_OF_MEDIAN * float(np.median(crowd)), 1e-6))


def _paint_ids(
    view: TableView, candidates: tuple[Candidate, ...], ids: IdImage, objects: tuple[PerceivedObject, ...]
) -> IdImage:
    """Paint the instance ids of the objects; where objects share pixels, the last one has them."""
    kept = np.where(view.on_plane, TABLE_ID, 0).astype(np.int32)
    for item in objects:
        kept[(ids == candidates[item.instance_id - 1].instance) & (ids > 0)] = item.instance_id
    return kept
