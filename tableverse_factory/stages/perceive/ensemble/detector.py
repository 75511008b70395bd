"""The detector `ensemble`: each pile by depth alone or by both, as the boundaries that our net sees decide."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float32
from scipy import ndimage

from schemas.config import Config
from schemas.geometry import IdImage, Mask
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.interfaces import DetectionResult
from tableverse_factory.stages.perceive.base.table_view import TableView
from tableverse_factory.stages.perceive.depth_segmenter.segment import detect_from_depth
from tableverse_factory.stages.perceive.ensemble.fused import detect_fused, upsample_map
from tableverse_factory.stages.perceive.picture.detector import find_standing, predict_view

BESIDE_PX = 3  # objects nearer to one another in the picture are of one pile
REACH_PX = 2  # a boundary this near is that of a border
INNER_WEIGHT = 0.35  # of a pixel within an object, against one on a border
LEAST_PROBABILITY = 0.02
FAVOUR = 0.6  # log-likelihood per pixel of border by which the answer of both must be better: depth is measured

Probabilities = Float32[np.ndarray, "h w"]


def detect_with_both(view: TableView, config: Config, services: Services) -> DetectionResult:
    """Detect objects by depth, and by depth and the net together, and choose one answer for each pile."""
    answers = detect_from_depth(view, config, services), detect_fused(view, config)
    ids = [_get_ids(answer) for answer in answers]
    seen = predict_view(view, config.perceive.detector_weights)
    boundary = upsample_map(seen.boundary, view.valid.shape)
    near = ndimage.binary_dilation((ids[0] > 0) | (ids[1] > 0), iterations=BESIDE_PX)
    piles, count = ndimage.label(near)
    takes_second = np.zeros(count + 1, dtype=bool)
    for pile, window in enumerate(ndimage.find_objects(piles), start=1):
        inside = piles[window] == pile
        takes_second[pile] = prefer_second([part[window] * inside for part in ids], boundary[window], inside)
    return replace(_merge_answers(answers, ids, piles, takes_second), shown=find_standing(view, seen))


def prefer_second(ids: Sequence[IdImage], boundary: Probabilities, inside: Mask) -> bool:
    """Decide whether the second of two segmentations of a pile explains the boundaries so much better that it is taken.

    `boundary` is their probability at each pixel.
    """
    borders = [_find_borders(each) & inside for each in ids]
    first, second = (_score_borders(border, boundary, inside) for border in borders)
    return bool(second - first > FAVOUR * max(1, *(int(border.sum()) for border in borders)))


def _score_borders(border: Mask, boundary: Probabilities, inside: Mask) -> float:
    """Compute the log-likelihood of the boundaries: probable on the borders, improbable within."""
    highest = 1.0 - LEAST_PROBABILITY
    near = np.clip(ndimage.maximum_filter(boundary, 2 * REACH_PX + 1), LEAST_PROBABILITY, highest)
    within = inside & ~ndimage.binary_dilation(border, iterations=REACH_PX + 1)
    empty = 1.0 - np.clip(boundary, LEAST_PROBABILITY, highest)
    return float(np.log(near[border]).sum() + INNER_WEIGHT * np.log(empty[within]).sum())


def _find_borders(ids: IdImage) -> Mask:
    """Find the pixels on both sides of a change of id."""
    border = np.zeros(ids.shape, dtype=bool)
    for first, second in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        differs = ids[first] != ids[second]
        border[first] |= differs
        border[second] |= differs
    return border


def _merge_answers(
    answers: Sequence[DetectionResult], ids: Sequence[IdImage], piles: IdImage, takes_second: np.ndarray
) -> DetectionResult:
    """Take from each answer what lies in its piles; `takes_second` says which from the second."""
    chosen = takes_second[piles]
    shares = [np.where(chosen == source, own, 0) for source, own in enumerate(ids)]
    kept = [
        (source, index)
        for source, answer in enumerate(answers)
        for index, candidate in enumerate(answer.candidates)
        if (shares[source] == candidate.instance).any()
    ]
    instances = {key: k for k, key in enumerate(kept, start=1)}
    merged, candidates = np.zeros_like(ids[0]), []
    for (source, index), instance in instances.items():
        candidate = answers[source].candidates[index]
        merged[shares[source] == candidate.instance] = instance
        holder = None if candidate.container is None else instances.get((source, candidate.container))
        container = None if holder is None else holder - 1
        candidates.append(replace(candidate, instance=instance, container=container))
    return DetectionResult(tuple(candidates), ids=merged)


def _get_ids(answer: DetectionResult) -> IdImage:
    if answer.ids is None:
        raise TypeError("both detectors answer with an image of ids")
    return answer.ids
