"""Objects of a prediction: pixels grouped by their votes, cut at boundaries, and merged where surfaces continue."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from jaxtyping import Float64
from scipy import ndimage
from scipy.spatial import cKDTree

from schemas.geometry import DepthImage, IdImage, Mask
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.models.picture.net import REACHES
from tableverse_factory.models.picture.predict import OBJECT, OTHER, TABLE, PicturePrediction

SPREAD_PX = 3.5  # standard deviation of the votes of one object about its middle
MIN_VOTES = 10  # at a peak of votes
MIN_PIECE_PX, MIN_OBJECT_PX = 20, 60
EDGE = 0.5  # probability from which a boundary separates
ACROSS_PX = 3  # surfaces are compared at this distance from the border of two pieces
MIN_CONTACT = 0.3  # length of that border, in square roots of the smaller piece's area
AGREED, LIKELY, SAME = 0.3, 0.6, 0.9  # votes between two middles, as a share of those at the lesser one
SURE = 1.5  # mean logit of pairs of pixels from which two pieces are of one object; below its negative they are of two
PROBABLE = -0.8  # the same on a smooth surface; odds are even at -1.1: training weighs pairs of two objects threefold
MIN_PROBABILITY = 0.55  # least mean probability of an object's pixels: those of a dark corner of the room have 0.44
# Parts that are labelled neither object nor table and yet stand on the table
SURELY_OTHER = 0.9  # mean probability of neither from which they are none: of people's arms, of what stands behind
MIN_PART_PX, MIN_PART_M = 100, 0.025  # least size and least median height over the table: lower ones are holes in it
PART_PIXEL_M = 0.005  # least height of each pixel [m]
DEPTH_STEP = 1.06  # least ratio of the depths on both sides of a depth discontinuity: the net's relief is flatter
MIN_TABLE_AROUND = 0.5  # least share of their surroundings that is table: a pocket in an object has less, and a chair
MAX_CONTINUED = 0.1  # most share of their surroundings to which they continue
FRAGMENT = 0.5  # least distance of a fragment's votes from its own middle, in radii of a disc of its area
ONE_MIDDLE = 0.2  # most distance of two fragments' votes, as a share of the extent of both
SMOOTH, CREASED = 0.45, 0.9  # distance out of the other's tangent plane, as a share of that across the line of sight


@dataclass(frozen=True, slots=True)
class _Border:
    """The border of two pieces that touch.

    Attributes:
        length: [px].
        bend: Median distance of one surface out of the other's tangent plane, as a share of that across the line of
            sight.
        boundary: Median probability of an edge.
        affinity: Mean logit that pixels on either side are of one object.
    """

    pieces: tuple[int, int]
    length: int
    bend: float
    boundary: float
    affinity: float


def segment_prediction(found: PicturePrediction, shape: tuple[int, int]) -> IdImage:
    """Segment the objects, ids from 1, the largest first, 0 elsewhere, at the size of the picture, (h, w)."""
    return upsample_ids(_find_objects(found), shape)


def label_standing_parts(found: PicturePrediction) -> PicturePrediction:
    """Label as objects the parts of a bare picture that stand on the table, though the net has labelled them otherwise.

    The net leaves out parts of objects, and objects far away. Such a part rises over the table and is surrounded by
    table for the most part, and elsewhere by objects or a depth discontinuity: walls, furniture and arms continue. It
    votes for its own middle.
    """
    label, votes = found.label.copy(), found.votes.copy()
    kind = label.argmax(axis=0)
    height = backproject(found.depth, found.camera) @ found.normal + found.distance_m
    rises = (kind == OTHER) & (height > PART_PIXEL_M)
    parts, _ = ndimage.label(rises & (found.depth < DEPTH_STEP * ndimage.minimum_filter(found.depth, 3)))
    for part, (rows, columns) in enumerate(ndimage.find_objects(parts), start=1):
        window = tuple(slice(its.start - ACROSS_PX, its.stop + ACROSS_PX) for its in (rows, columns))
        if any(its.start < 0 or its.stop > n for its, n in zip(window, parts.shape, strict=True)):
            continue  # at the border of the picture nobody knows how it continues
        mask = parts[window] == part
        if (
            mask.sum() >= MIN_PART_PX
            and np.median(height[window][mask]) > MIN_PART_M
            and label[OTHER][window][mask].mean() <= SURELY_OTHER
            and _ends_all_around(mask, found.depth[window], kind[window], rises[window])
        ):
            label[OBJECT][window][mask] += label[OTHER][window][mask]
            label[OTHER][window][mask] = 0.0
            at = np.argwhere(mask)
            votes[::-1, *window][:, mask] = (at.mean(axis=0) - at).T
    return replace(found, label=label, votes=votes)


def _ends_all_around(mask: Mask, depth: DepthImage, kind: IdImage, rises: Mask) -> bool:
    """Whether table surrounds a part for the most part, and it continues nowhere in what else rises at its depth."""
    around = ndimage.binary_dilation(mask, iterations=ACROSS_PX) & ~mask
    nearest = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    continued = rises & (depth <= DEPTH_STEP * depth[tuple(nearest)])
    table, more = (float(share[around].mean()) for share in (kind == TABLE, continued))
    return table >= MIN_TABLE_AROUND and more <= MAX_CONTINUED


def _find_objects(found: PicturePrediction) -> IdImage:
    is_object = found.label.argmax(axis=0) == OBJECT
    density, middles, nearest = _group_votes(found, is_object)
    pieces, middle_of = _cut_pieces(nearest, found.boundary < EDGE)
    pieces = np.where(is_object, _spread(pieces), 0)
    sizes = np.bincount(pieces.ravel(), minlength=len(middle_of))
    borders = list(_measure_borders(found, pieces))
    wanted = []
    for border in borders:
        a, b = border.pieces
        agreement = _measure_agreement(density, middles[middle_of[a]], middles[middle_of[b]])
        touches = border.length >= MIN_CONTACT * np.sqrt(min(sizes[a], sizes[b]))
        limit = CREASED if agreement >= LIKELY else SMOOTH if agreement >= AGREED else 0.0
        continues = border.boundary < EDGE and border.bend < limit and border.affinity > -SURE
        if touches and (continues or border.affinity > SURE):
            wanted.append((border, -SURE))
        elif touches and border.affinity > PROBABLE and (border.bend < SMOOTH or agreement >= SAME):
            wanted.append((border, PROBABLE))
    group = _merge_pieces(wanted, borders, len(middle_of))
    touching = {tuple(sorted(group[list(border.pieces)].tolist())) for border in borders}
    ids = _join_fragments(found, group[pieces], touching)
    count = np.bincount(ids.ravel())
    sure = np.bincount(ids.ravel(), found.label[OBJECT].ravel()) >= MIN_PROBABILITY * count
    return _renumber(np.where(sure[ids], ids, 0))


def _merge_pieces(wanted: Sequence[tuple[_Border, float]], borders: Sequence[_Border], count: int) -> IdImage:
    """Merge across the wanted borders, the surest first, and number the group of each of `count` pieces.

    Each comes with the least mean logit of the groups' whole common border: else a chain of scraps in a shadow joins a
    cup to its saucer.
    """
    pairs = np.array([border.pieces for border in borders], dtype=np.int32).reshape(-1, 2)
    length = np.array([border.length for border in borders])
    says = length * np.array([border.affinity for border in borders])
    group = np.arange(count, dtype=np.int32)
    for border, least in sorted(wanted, key=lambda each: (-each[0].affinity, each[0].pieces)):
        one, two = group[list(border.pieces)]
        sides = group[pairs]
        common = (sides == (one, two)).all(axis=1) | (sides == (two, one)).all(axis=1)
        if says[common].sum() > least * length[common].sum():
            group[group == two] = one
    return group


def _join_fragments(found: PicturePrediction, ids: IdImage, touching: set[tuple[int, ...]]) -> IdImage:
    """Join what others hide the middle of: groups that lie apart and vote for one place.

    A whole object votes for its own middle; the visible rest of a plate votes for where the plate's middle is.
    """
    fragments = []
    for k in np.flatnonzero(np.bincount(ids.ravel()) >= MIN_OBJECT_PX // 2):
        at = np.argwhere(ids == k)
        middle, vote = at.mean(axis=0), (at + found.votes[::-1, at[:, 0], at[:, 1]].T).mean(axis=0)
        if k > 0 and np.linalg.norm(vote - middle) > FRAGMENT * np.sqrt(len(at) / np.pi):
            fragments.append((int(k), at, middle, vote))
    result = ids.copy()
    for (one, at, middle, vote), (two, other_at, other_middle, other_vote) in combinations(fragments, 2):
        reach = float(np.linalg.norm(np.ptp(np.concatenate([at, other_at]), axis=0)))
        towards = (vote - middle) @ (other_middle - middle) > 0.0
        near = float(np.linalg.norm(vote - other_vote)) < ONE_MIDDLE * reach
        if near and towards and (one, two) not in touching:
            result[result == result[tuple(other_at[0])]] = result[tuple(at[0])]
    return result


def _group_votes(found: PicturePrediction, is_object: Mask) -> tuple[Float64[np.ndarray, "h w"], np.ndarray, IdImage]:
    """Find the density of votes, its peaks as rows and columns, and the peak from 1 nearest to each pixel's vote."""
    rows, columns = np.nonzero(is_object)
    height, width = is_object.shape
    at = np.stack([rows + found.votes[1][is_object], columns + found.votes[0][is_object]], axis=-1)
    at = np.clip(at, 0, [height - 1, width - 1])
    counts = np.zeros(is_object.shape)
    np.add.at(counts, tuple(np.rint(at).astype(np.intp).T), 1.0)
    density = ndimage.gaussian_filter(counts, SPREAD_PX) * (2.0 * np.pi * SPREAD_PX**2)
    around = 2 * int(1.5 * SPREAD_PX) + 1
    middles = np.argwhere((density == ndimage.maximum_filter(density, around)) & (density > MIN_VOTES))
    nearest = np.zeros(is_object.shape, dtype=np.int32)
    if len(middles):
        nearest[is_object] = cKDTree(middles).query(at)[1] + 1
    return density, middles, nearest


def _cut_pieces(nearest: IdImage, inside: Mask) -> tuple[IdImage, np.ndarray]:
    """Cut each group into connected pieces, numbered from 1, and find the index of each one's middle."""
    pieces, middle_of = np.zeros(nearest.shape, dtype=np.int32), [0]
    for middle, window in enumerate(ndimage.find_objects(nearest)):
        if window is None:
            continue
        parts, count = ndimage.label((nearest[window] == middle + 1) & inside[window])
        sizes = np.bincount(parts.ravel(), minlength=count + 1)
        for part in range(1, count + 1):
            if sizes[part] >= MIN_PIECE_PX:
                pieces[window][parts == part] = len(middle_of)
                middle_of.append(middle)
    return pieces, np.array(middle_of)


def _spread(pieces: IdImage) -> IdImage:
    """Give every pixel the nearest piece; 0 where there is none at all."""
    nearest = ndimage.distance_transform_edt(pieces == 0, return_distances=False, return_indices=True)
    return pieces[tuple(nearest)]


def _measure_agreement(density: Float64[np.ndarray, "h w"], a: np.ndarray, b: np.ndarray) -> float:
    """Measure the least density of votes between two peaks, as a share of that at the lesser peak."""
    steps = np.rint(np.linspace(a, b, 9)).astype(np.intp)
    return float(density[tuple(steps.T)].min() / min(density[tuple(a)], density[tuple(b)]))


def _measure_borders(found: PicturePrediction, pieces: IdImage) -> Iterator[_Border]:
    """Measure the borders of all pairs of pieces that touch, in the order of their numbers."""
    points = backproject(found.depth, found.camera)
    smooth = ndimage.uniform_filter(points, (5, 5, 1))
    normals = np.cross(np.gradient(smooth, axis=0), np.gradient(smooth, axis=1))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    parts = [
        _compare_across(*(np.moveaxis(a, axis, 0) for a in (pieces, points, normals, found.boundary)))
        for axis in (0, 1)
    ]
    pairs, bends, edges = (np.concatenate(part) for part in zip(*parts, strict=True))
    bends *= found.camera.fx
    keys, index = np.unique(pairs, axis=0, return_inverse=True)
    affinities = {pair: logits / count for pair, logits, count in zip(*sum_affinities(found, pieces), strict=True)}
    for k, (a, b) in enumerate(keys.tolist()):
        on, affinity = index.ravel() == k, affinities.get((a, b), PROBABLE)
        yield _Border((a, b), int(on.sum()), float(np.median(bends[on])), float(np.median(edges[on])), affinity)


def sum_affinities(found: PicturePrediction, pieces: IdImage) -> tuple[list[tuple[int, int]], list[float], list[float]]:
    """Sum the logits of all pairs of pixels that lie on two pieces.

    Returns the pairs of pieces, the one of the lesser number first, the sums, and the numbers of pairs of pixels.
    """
    pairs, logits = [], []
    for (reach, axis), map_ in zip(product(REACHES, (1, 0)), found.affinity, strict=True):
        own, values = (np.moveaxis(each, axis, 0)[:-reach] for each in (pieces, map_))
        other = np.moveaxis(pieces, axis, 0)[reach:]
        on = (own > 0) & (other > 0) & (own != other)
        pairs.append(np.sort(np.stack([own[on], other[on]], axis=-1), axis=-1))
        logits.append(values[on])
    keys, index, counts = np.unique(np.concatenate(pairs), axis=0, return_inverse=True, return_counts=True)
    sums = np.bincount(index.ravel(), np.concatenate(logits), len(keys))
    return [(a, b) for a, b in keys.tolist()], sums.tolist(), counts.astype(np.float64).tolist()


def _compare_across(
    pieces: np.ndarray, points: np.ndarray, normals: np.ndarray, boundary: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare both sides of each border that crosses the first axis: the pieces, the bend and the boundary."""
    gap = 2 * ACROSS_PX + 1
    sides, middle = np.s_[:-gap], np.s_[ACROSS_PX : -ACROSS_PX - 1]
    far = pieces[gap:]
    crosses = (pieces[sides] == pieces[middle]) & (far == pieces[ACROSS_PX + 1 : -ACROSS_PX])
    crosses &= (pieces[sides] != far) & (pieces[sides] > 0) & (far > 0)
    between = points[gap:][crosses] - points[sides][crosses]
    out = sum(np.abs((normals[part][crosses] * between).sum(axis=-1)) for part in (sides, np.s_[gap:])) / 2.0
    reach = gap * np.minimum(points[sides][crosses][:, 2], points[gap:][crosses][:, 2])
    edge = ndimage.maximum_filter1d(boundary, 2 * ACROSS_PX + 1, axis=0)[middle][crosses]
    pairs = np.sort(np.stack([pieces[sides][crosses], far[crosses]], axis=-1), axis=-1)
    return pairs, out / reach, edge


def _renumber(ids: np.ndarray) -> IdImage:
    """Number the ids of enough pixels from 1, the largest first; the others become 0."""
    known, index, sizes = np.unique(ids, return_inverse=True, return_counts=True)
    sizes[known == 0] = 0
    order = np.argsort(-sizes, kind="stable")
    number = np.zeros(len(known), dtype=np.int32)
    kept = order[sizes[order] >= MIN_OBJECT_PX]
    number[kept] = np.arange(1, len(kept) + 1)
    return number[index].reshape(ids.shape)


def upsample_ids(ids: IdImage, shape: tuple[int, int]) -> IdImage:
    """Resize an image of ids: each pixel has the id with a bilinear weight of more than one half there, else 0."""
    if ids.shape == shape:
        return ids
    result, best = np.zeros(shape, dtype=np.int32), np.full(shape, 0.5, dtype=np.float32)
    down, across = (_make_weights(small, large) for small, large in zip(ids.shape, shape, strict=True))
    for k, window in enumerate(ndimage.find_objects(ids), start=1):
        if window is None:
            continue
        spans = [
            np.flatnonzero(weights[:, part].any(axis=1)) for weights, part in zip((down, across), window, strict=True)
        ]
        target = tuple(slice(int(span[0]), int(span[-1]) + 1) for span in spans)
        weight = down[target[0], window[0]] @ (ids[window] == k).astype(np.float32) @ across[target[1], window[1]].T
        wins = weight > best[target]
        result[target][wins] = k
        best[target][wins] = weight[wins]
    return result


def _make_weights(small: int, large: int) -> np.ndarray:
    """Make the matrix that interpolates `large` pixels from `small` that cover the same length."""
    places = np.clip((np.arange(large) + 0.5) * (small / large) - 0.5, 0.0, small - 1.0)
    low = np.minimum(places.astype(np.intp), max(small - 2, 0))
    weights = np.zeros((large, small), dtype=np.float32)
    weights[np.arange(large), low] = 1.0 - (places - low)
    weights[np.arange(large), np.minimum(low + 1, small - 1)] += places - low
    return weights
