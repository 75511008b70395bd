"""Over-segmentation along borders, then merging across the weakest ones into objects."""

import heapq
import operator
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int32, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from skimage.segmentation import watershed

from schemas.geometry import IdImage, Mask
from tableverse_factory.stages.perceive.base.object_filter import renumber_regions
from tableverse_factory.stages.perceive.depth_segmenter.surface import DIRECTIONS, Surface, measure_border, shift_image

SEED_SPACING_M = 0.013  # distance of the seeds of patches at the depth of the objects
MIN_SPACING_PX, MAX_SPACING_PX = 6, 16  # bounds of it in the picture
COMPACTNESS = 0.02  # of the patches, see `skimage.segmentation.watershed`: 0 lets them follow borders alone
MERGED_BELOW = 1.0  # strength of a border up to which patches are merged; 1 is certain, see `Surface.borders`
SHORT_BORDER = 2.0  # length below which a border counts as stronger, in square roots of the smaller region's pixels
MAX_GAP_PX = 4  # patches so far apart touch if nothing was read between them
MAX_JUMP_M = 0.02  # border pixels join no region over a larger jump in depth


class Link(NamedTuple):
    """Sums over the border of two patches; the last two are of pairs of pixels on either side, where a net judges."""

    strength: float
    length: float  # [px]
    logits: float = 0.0
    pairs: float = 0.0


Links = dict[int, dict[int, Link]]  # of each patch with its neighbours


def oversegment(borders: Float64[np.ndarray, "h w"], mask: Mask, pitch_m: float) -> IdImage:
    """Split the mask into small patches that respect borders by a compact watershed from a grid of seeds."""
    spacing = int(np.clip(round(SEED_SPACING_M / pitch_m), MIN_SPACING_PX, MAX_SPACING_PX))
    seeds = np.zeros(mask.shape, dtype=np.int32)
    grid = seeds[spacing // 2 :: spacing, spacing // 2 :: spacing]
    grid[...] = np.arange(1, grid.size + 1).reshape(grid.shape)
    found = watershed(borders, seeds * mask, mask=mask, compactness=COMPACTNESS)
    values, numbered = np.unique(found, return_inverse=True)
    return numbered.reshape(mask.shape).astype(np.int32) + (0 if values[0] == 0 else 1)


def merge_patches(ids: IdImage, surface: Surface) -> IdImage:
    """Merge patches, the weakest border first, until every border is strong along its whole length.

    The strength of a border is its mean over all pixels along which the two regions touch, so that a short gap in a
    crease does not join two objects that have grown on either side of it.
    """
    return merge_linked(ids, build_links(ids, surface), _compute_strength, MERGED_BELOW)


def merge_linked(ids: IdImage, links: Links, measure: Callable[[Link, int, int], float], most: float) -> IdImage:
    """Merge linked patches, the weakest border first, while it is no stronger than `most`; uses up `links`.

    `measure` tells a border's strength from its link and the numbers of pixels on either side.
    """
    sizes = np.bincount(ids.ravel()).tolist()
    into = list(range(len(sizes)))
    version = [0] * len(into)
    pairs = ((a, b, link) for a in links for b, link in links[a].items() if a < b)
    heap = [(measure(link, sizes[a], sizes[b]), a, b, 0, 0) for a, b, link in pairs]
    heapq.heapify(heap)
    while heap:
        strength, a, b, version_a, version_b = heapq.heappop(heap)
        if strength > most:
            break
        if version[a] != version_a or version[b] != version_b:
            continue
        into[b] = a
        sizes[a] += sizes[b]
        version[a] += 1
        version[b] += 1
        _merge_links(links, a, b)
        for c, link in links[a].items():
            low, high = min(a, c), max(a, c)
            heapq.heappush(heap, (measure(link, sizes[a], sizes[c]), low, high, version[low], version[high]))
    for k, target in enumerate(into):  # a patch only ever goes into a lower one, whose own root is known by then
        into[k] = into[target]
    return np.array(into)[ids].astype(np.int32)


def _compute_strength(link: Link, size_a: int, size_b: int) -> float:
    """Compute the mean strength of a border, raised where it is short for the size of the smaller region."""
    mean = link.strength / link.length
    return float(mean * max(1.0, SHORT_BORDER * float(min(size_a, size_b)) ** 0.5 / link.length))


def build_links(ids: IdImage, surface: Surface) -> Links:
    """Link every two patches that touch by the sum of their border's strength and its length [px]."""
    count = int(ids.max(initial=0)) + 1
    found = (borders for direction in DIRECTIONS for borders in _find_borders(ids, surface, direction))
    lows, highs, strengths = map(np.concatenate, zip(*found, strict=True))
    pairs, which = np.unique(lows.astype(np.int64) * count + highs, return_inverse=True)
    totals = np.bincount(which, weights=strengths, minlength=len(pairs))
    lengths = np.bincount(which, minlength=len(pairs))
    links: Links = {}
    for key, total, length in zip(pairs.tolist(), totals.tolist(), lengths.tolist(), strict=True):
        a, b = divmod(key, count)
        links.setdefault(a, {})[b] = links.setdefault(b, {})[a] = Link(total, length)
    return links


def _find_borders(
    ids: IdImage, surface: Surface, direction: tuple[int, int]
) -> Iterator[tuple[Int32[np.ndarray, " n"], Int32[np.ndarray, " n"], Float64[np.ndarray, " n"]]]:
    """Find pairs of pixels with the lower and the higher id, and the strength of the border between them.

    They are neighbours, or a few pixels apart without a reading and of no patch, as sensors leave where the surface
    steps back.
    """
    nothing, open_gap = (surface.points[..., 2] == 0) & (ids == 0), np.ones(ids.shape, dtype=bool)
    for distance in range(1, MAX_GAP_PX + 1):
        rows, columns = distance * direction[0], distance * direction[1]
        other = shift_image(ids, rows, columns)
        y, x = np.nonzero(open_gap & (ids > 0) & (other > 0) & (ids != other))
        touch, ahead = (y, x), (y + rows, x + columns)
        if distance == 1:
            strength = np.maximum(surface.borders[touch], surface.borders[ahead])
        else:
            strength = measure_border(surface, touch, ahead)
        yield np.minimum(ids, other)[touch], np.maximum(ids, other)[touch], strength
        open_gap &= shift_image(nothing, rows, columns)


def _merge_links(links: Links, a: int, b: int) -> None:
    """Hand the neighbours of `b` to `a`."""
    del links[a][b], links[b][a]
    for c, link in links.pop(b).items():
        del links[c][b]
        known = links[a].get(c)
        links[a][c] = links[c][a] = Link(*map(operator.add, known, link)) if known else link


def attach_border_pixels(ids: IdImage, surface: Surface, mask: Mask, least_pixels: int) -> IdImage:
    """Keep regions of at least `least_pixels`, numbered from 1, and attach every other pixel of `mask` to one of them.

    Each goes where the path over neighbouring pixels has the smallest jump in depth (a minimum spanning forest);
    unreachable ones form a region of their own if it is large enough, else they are dropped.
    """
    large = _keep_large(ids, least_pixels)
    cores, n_large = large * mask, int(large.max(initial=0))
    nodes = np.where(mask & (cores == 0), np.cumsum(mask & (cores == 0)).reshape(mask.shape) + n_large, cores)
    a, b, jump = _build_pixel_graph(nodes, mask, surface)
    count = int(nodes.max(initial=0)) + 1
    roots = np.arange(1, n_large + 1)
    weights = np.concatenate([jump, np.full(len(roots), 1e-12)])
    ends = np.concatenate([a, np.zeros(len(roots), dtype=np.int64)]), np.concatenate([b, roots])
    graph = coo_array((weights, ends), shape=(count, count))
    forest = minimum_spanning_tree(graph.tocsr()).tocoo()
    inner = (forest.row > 0) & (forest.col > 0)
    split = coo_array((forest.data[inner], (forest.row[inner], forest.col[inner])), shape=(count, count))
    _, trees = connected_components(split, directed=False)
    return _keep_large(trees[nodes] * (nodes > 0) + (nodes > 0), least_pixels)


def _build_pixel_graph(
    nodes: Int64[np.ndarray, "h w"], mask: Mask, surface: Surface
) -> tuple[Int64[np.ndarray, " e"], Int64[np.ndarray, " e"], Float64[np.ndarray, " e"]]:
    """Build the edges between neighbouring nodes with the least jump in depth [m], each pair once."""
    depth = surface.points[..., 2]
    first, second, jumps = [], [], []
    for rows, columns in DIRECTIONS:
        other, jump = shift_image(nodes, rows, columns), np.abs(shift_image(depth, rows, columns) - depth)
        touch = mask & (other > 0) & (other != nodes) & (jump < MAX_JUMP_M)
        first.append(np.minimum(nodes, other)[touch])
        second.append(np.maximum(nodes, other)[touch])
        jumps.append(jump[touch] + 1e-9)
    a, b, jump = np.concatenate(first), np.concatenate(second), np.concatenate(jumps)
    order = np.lexsort((jump, b, a))
    a, b, jump = a[order], b[order], jump[order]
    once = np.ones(len(a), dtype=bool)
    once[1:] = (a[1:] != a[:-1]) | (b[1:] != b[:-1])
    return a[once], b[once], jump[once]


def _keep_large(ids: Int64[np.ndarray, "h w"] | IdImage, least_pixels: int) -> IdImage:
    """Renumber the ids with enough pixels from 1, in their order; the others become 0."""
    kept = np.flatnonzero(np.bincount(ids.ravel()) >= least_pixels)
    return renumber_regions(ids, kept[kept > 0].tolist())
