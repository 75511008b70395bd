"""The detector `ensemble`: each group by depth, by the net, or by both, as the boundaries that the net sees decide."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from schemas.config import Config
from schemas.geometry import IdImage, Mask
from tableverse_factory.models.picture.predict import TABLE
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.interfaces import DetectionResult
from tableverse_factory.stages.perceive.base.table_view import TableView, expand_window
from tableverse_factory.stages.perceive.depth_segmenter.segment import detect_from_depth, to_box
from tableverse_factory.stages.perceive.ensemble.fused import detect_fused, upsample_map
from tableverse_factory.stages.perceive.picture.detector import detect_predicted, find_label, predict_view

REACH_PX = 2  # a boundary this near is that of a border: the net sees every second or third pixel of a picture
INNER_WEIGHT = 0.35  # of a pixel within an object, against one on a border
LEAST_PROBABILITY = 0.02  # and most certainty: so that no single pixel decides
MIN_LEFT = 0.5  # share of an object of the second answer that the first must leave, else it is none
COMMON_SHARE = 0.3  # of the smaller of two objects, one of each answer, from which they are of one group
# Log-likelihood per pixel of border by which the answer of both must be better, as depth is measured; less where each
# has one object, and only its outline is in question. One of more objects may be worse by as much: a sensor joins what
# touches and misses what is thin, but sees no seams where there are none.
FAVOUR, OUTLINE_FAVOUR = 0.35, 0.1
# The same for an object that the net alone sees; and the share of a group without a reading from which its answer need
# only be better: the best for 80 rendered tables of those that leave the captures of OSD as they are. Of one object it
# parts none: handles, caps and what is painted in two colours are one for depth.
ADDING_FAVOUR, LEAST_UNREAD = 0.2, 0.1
# Mean probability of table from which what depth raises by less than this is table under a sensor that bends its depth:
# 18 false objects of bent captures have 0.98 and more, of 1,174 objects of captures none has more than 0.81.
SURELY_TABLE, MAX_BENT_M = 0.95, 0.03

Probabilities = Float32[np.ndarray, "h w"]


class Comparison(NamedTuple):
    """Two segmentations of one group of objects.

    Attributes:
        counts: Objects of each.
        gain: Log-likelihood of the boundaries by which the second explains them better, per pixel of border.
        unread: Share of the group's pixels without a reading.
    """

    counts: tuple[int, int]
    gain: float
    unread: float


def detect_with_ensemble(view: TableView, config: Config, services: Services) -> DetectionResult:
    """Detect objects by depth, by depth and the net, and by the net alone, and choose an answer for each group."""
    seen = predict_view(view, config.perceive.detector_weights)
    boundary = upsample_map(seen.boundary, view.valid.shape)
    unread, fused = view.observation.depth <= 0, detect_fused(view, seen)
    by_depth = _choose_answers(detect_from_depth(view, config, services), fused, boundary, unread, prefer_fused)
    bent = find_bent_table(_get_ids(by_depth), view, upsample_map(seen.label[TABLE], view.valid.shape))
    by_depth = replace(by_depth, ids=np.where(bent, 0, _get_ids(by_depth)))
    answer = _choose_answers(by_depth, detect_predicted(view, seen), boundary, unread, prefer_net)
    answer = contain_as(by_depth, answer)  # depth shows hollows better than the net alone
    return replace(answer, shown=fused.shown & ~bent, table_top=find_label(seen, TABLE, view.valid.shape))


def _choose_answers(
    first: DetectionResult,
    second: DetectionResult,
    boundary: Probabilities,
    unread: Mask,
    prefers_second: Callable[[Comparison], bool],
) -> DetectionResult:
    """Take the second answer for each group of objects of which it is preferred, else the first."""
    answers = first, second
    ids, contained = [_get_ids(answer) for answer in answers], [_list_contained(answer) for answer in answers]
    numbers = group_objects(ids[0], ids[1], contained[0], contained[1])
    groups = [number[own] for number, own in zip(numbers, ids, strict=True)]
    takes_second = np.zeros(max(int(each.max()) for each in groups) + 1, dtype=bool)
    for group in np.setdiff1d(groups, 0):
        window = expand_window((groups[0] == group) | (groups[1] == group), 2 * REACH_PX)
        own = [np.where(each[window] == group, part[window], 0) for each, part in zip(groups, ids, strict=True)]
        takes_second[group] = prefers_second(compare_answers(own, boundary[window], unread[window]))
    return _merge_answers(answers, ids, groups, takes_second)


def _list_contained(answer: DetectionResult) -> list[tuple[int, int]]:
    """List the ids of contents and of what holds them."""
    held = ((each.instance, each.container) for each in answer.candidates)
    return [(own, answer.candidates[holder].instance) for own, holder in held if holder is not None]


def group_objects(
    first: IdImage,
    second: IdImage,
    contained_in_first: Sequence[tuple[int, int]] = (),
    contained_in_second: Sequence[tuple[int, int]] = (),
) -> tuple[IdImage, IdImage]:
    """Group objects of two answers that overlap, and contents with what holds them in either answer.

    `contained_in_…` lists the ids of contents and of what holds them. Returns the number of the group of each id of
    either answer, from 1, and 0 for no object. Shapes (n + 1,) and (m + 1,), where n and m are the highest ids.
    """
    counts = [
        max(int(ids.max(initial=0)), *(max(pair) for pair in contained), 0)
        for ids, contained in ((first, contained_in_first), (second, contained_in_second))
    ]
    total = sum(counts)
    if not total:
        return np.zeros(1, np.int32), np.zeros(1, np.int32)
    numbers, shape = first.astype(np.int64) * (counts[1] + 1) + second, (counts[0] + 1, counts[1] + 1)
    common = np.bincount(numbers.ravel(), minlength=math.prod(shape)).reshape(shape)
    smaller = np.minimum(common.sum(axis=1)[:, None], common.sum(axis=0))
    shared = np.argwhere(common[1:, 1:] > COMMON_SHARE * smaller[1:, 1:]) + 1
    links = np.concatenate(
        [
            shared + np.array([0, counts[0]]),
            np.array(contained_in_first, dtype=np.intp).reshape(-1, 2),
            np.array(contained_in_second, dtype=np.intp).reshape(-1, 2) + counts[0],
        ]
    )
    graph = coo_array((np.ones(len(links)), tuple(links.T - 1)), shape=(total, total))
    group = connected_components(graph, directed=False)[1].astype(np.int32) + 1
    return np.append(np.int32(0), group[: counts[0]]), np.append(np.int32(0), group[counts[0] :])


def compare_answers(ids: Sequence[IdImage], boundary: Probabilities, unread: Mask) -> Comparison:
    """Compare two segmentations of a group by the probability of a boundary at each pixel. Shapes (h, w)."""
    own = (ids[0] > 0) | (ids[1] > 0)
    inside = ndimage.binary_dilation(own, iterations=REACH_PX)
    borders = [_find_borders(each) & inside for each in ids]
    first, second = (_score_borders(border, boundary, inside) for border in borders)
    length = max(1, *(int(border.sum()) for border in borders))
    count_first, count_second = (len(np.unique(each[each > 0])) for each in ids)
    share = float(unread[own].mean()) if own.any() else 0.0
    return Comparison((count_first, count_second), (second - first) / length, share)


def prefer_fused(compared: Comparison) -> bool:
    """Decide whether the answer of depth and net is so much better than that of depth that it is taken."""
    first, second = compared.counts
    return compared.gain > (OUTLINE_FAVOUR if compared.counts == (1, 1) else math.copysign(FAVOUR, first - second))


def prefer_net(compared: Comparison) -> bool:
    """Decide whether the answer of the net alone is taken: what it alone sees, or several that are not all read."""
    first, second = compared.counts
    if first == 0:
        return compared.gain > ADDING_FAVOUR
    return first > 1 and second > 0 and compared.unread > LEAST_UNREAD and compared.gain > 0.0


def find_bent_table(ids: IdImage, view: TableView, table_probability: Probabilities) -> Mask:
    """Find the objects that are table: bent depth raises it a little, and the net sees nothing else; shapes (h, w).

    What has no reading, depth has not raised.
    """
    read = np.where(view.valid, ids, 0)
    labels = np.unique(read[read > 0])
    if not len(labels):
        return np.zeros(ids.shape, dtype=bool)
    probable, height = ndimage.mean(table_probability, read, labels), ndimage.median(view.heights, read, labels)
    return np.isin(ids, labels[(probable > SURELY_TABLE) & (height < MAX_BENT_M)])


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
    answers: Sequence[DetectionResult], ids: Sequence[IdImage], groups: Sequence[IdImage], takes_second: np.ndarray
) -> DetectionResult:
    """Take from each answer its groups; those of the second, as `takes_second` says, fill what the first leaves."""
    shares = [np.where(takes_second[groups[0]], 0, ids[0])]
    shares.append(np.where(takes_second[groups[1]] & (shares[0] == 0), ids[1], 0))
    left = [_list_left(own, share) for own, share in zip(ids, shares, strict=True)]
    kept = [
        (source, index)
        for source, answer in enumerate(answers)
        for index, candidate in enumerate(answer.candidates)
        if candidate.instance in left[source]
    ]
    instances = {key: k for k, key in enumerate(kept, start=1)}
    merged, candidates = np.zeros_like(ids[0]), []
    for (source, index), instance in instances.items():
        candidate = answers[source].candidates[index]
        merged[shares[source] == candidate.instance] = instance
        holder = None if candidate.container is None else instances.get((source, candidate.container))
        container = None if holder is None else holder - 1
        candidates.append(replace(candidate, instance=instance, container=container))
    boxes = map(to_box, ndimage.find_objects(merged))
    boxed = (replace(candidate, box=box) for candidate, box in zip(candidates, boxes, strict=True))
    return DetectionResult(tuple(boxed), ids=merged)


def contain_as(known: DetectionResult, answer: DetectionResult) -> DetectionResult:
    """Contain the objects of an answer in one another as another, `known`, tells; those that it lacks stay as they are.

    An object of either is one of the other if most of both are the same pixels. Containers come before their contents.
    """
    ids, candidates = [_get_ids(each) for each in (known, answer)], answer.candidates
    index_of = {candidate.instance: index for index, candidate in enumerate(candidates)}
    successors = {candidate.instance: _find_successor(ids, candidate.instance) for candidate in known.candidates}
    same = set(successors.values())
    pairs = [[successors[instance] for instance in pair] for pair in _list_contained(known)]
    pairs += [[*pair] for pair in _list_contained(answer) if same.isdisjoint(pair)]
    holders = {index_of[own]: index_of[holder] for own, holder in pairs if own in index_of and holder in index_of}
    order = sorted(range(len(candidates)), key=lambda index: len(_list_holders(index, holders)))
    place = {index: k for k, index in enumerate(order)}
    found, numbers = [], np.zeros(max([int(ids[1].max(initial=0)), *index_of]) + 1, dtype=np.int32)
    for k, index in enumerate(order):
        numbers[candidates[index].instance] = k + 1
        found.append(replace(candidates[index], instance=k + 1, container=place.get(holders.get(index, -1))))
    return replace(answer, candidates=tuple(found), ids=numbers[ids[1]])


def _find_successor(ids: Sequence[IdImage], instance: int) -> int:
    """Find the object of the second image of ids that most of an object of the first is, and which is mostly that."""
    mask = ids[0] == instance
    counts = np.bincount(ids[1][mask], minlength=1)
    best = int(counts.argmax())
    sizes = int(mask.sum()), int((ids[1] == best).sum())
    return best if best and counts[best] > MIN_LEFT * max(sizes) else 0


def _list_holders(index: int, holders: Mapping[int, int]) -> list[int]:
    """List what holds an object, what holds that, and so on."""
    found = []
    while index in holders:
        index = holders[index]
        found.append(index)
    return found


def _list_left(ids: IdImage, share: IdImage) -> list[int]:
    """List the objects that keep most of their pixels in a share of them."""
    sizes = np.bincount(ids.ravel())
    left = np.bincount(share.ravel(), minlength=len(sizes))
    return [k for k in range(1, len(sizes)) if left[k] >= MIN_LEFT * sizes[k] > 0]


def _get_ids(answer: DetectionResult) -> IdImage:
    if answer.ids is None:
        raise TypeError("these detectors answer with an image of ids")
    return answer.ids
