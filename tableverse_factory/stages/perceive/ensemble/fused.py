"""Objects of a sensor's depth and our net together: small patches, merged across borders that neither sees."""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float32
from PIL import Image
from scipy import ndimage

from schemas.geometry import DepthImage, IdImage, Mask
from tableverse_factory.models.picture.instances import sum_affinities
from tableverse_factory.models.picture.predict import OBJECT, PicturePrediction, take_nearest
from tableverse_factory.stages.perceive.base.interfaces import DetectionResult
from tableverse_factory.stages.perceive.base.object_filter import (
    drop_unseen_regions,
    keep_objects,
    keep_regions_over_table,
    renumber_regions,
)
from tableverse_factory.stages.perceive.base.table_view import (
    ImageWindow,
    TableView,
    crop_view,
    find_working_window,
    uncrop_ids,
)
from tableverse_factory.stages.perceive.depth_segmenter.merge_regions import merge_occluded_parts
from tableverse_factory.stages.perceive.depth_segmenter.oversegment import (
    Link,
    attach_border_pixels,
    build_links,
    merge_linked,
    oversegment,
)
from tableverse_factory.stages.perceive.depth_segmenter.rims import find_rims
from tableverse_factory.stages.perceive.depth_segmenter.segment import (
    MARGIN_PX,
    WORKING_PIXELS,
    compute_least_pixels,
    fill_holes,
    to_detections,
)
from tableverse_factory.stages.perceive.depth_segmenter.surface import Surface, compute_surface
from tableverse_factory.stages.perceive.depth_segmenter.vessels import find_containers
from tableverse_factory.stages.perceive.picture.detector import find_standing

MAX_OPENING_SHARE = 0.02  # of the picture
RING_PX, MIN_STEP_M = 3, 0.02  # the sensor loses readings at edges; what stands near an opening is so much nearer
SURELY_OBJECT = 0.6  # probability of an object from which a pixel is one that the sensor does not see rise
# Strength of a border up to which two regions are one; the best of eight on rendered tables, and a sum of fractions of
# two, so that the mean over a border of which nothing is known is no more.
FUSED_BELOW = 1.3125
AFFINITY_WEIGHT = 0.35  # strength in depth that a logit of the net outweighs: logistic regression on 32 such tables


def detect_fused(view: TableView, seen: PicturePrediction) -> DetectionResult:
    """Detect objects as unnamed candidates, the largest first, by a sensor's depth and what the net has `seen`."""
    standing = find_standing(view, seen)
    return replace(_detect(view, seen, standing), shown=standing)


def _detect(view: TableView, seen: PicturePrediction, standing: Mask) -> DetectionResult:
    shape = view.valid.shape
    sure = upsample_map(seen.label[OBJECT], shape) > SURELY_OBJECT
    mask = standing | (sure & ~find_openings(standing, view.observation.depth))
    if not mask.any():
        return to_detections(np.zeros(shape, dtype=np.int32), {})
    window = find_working_window(mask, WORKING_PIXELS, MARGIN_PX)
    part, own = replace(crop_view(view, window), raised=mask[window.slices]), mask[window.slices]
    if not (own & part.valid).any():  # what is there lies between the pixels of a large picture that are looked at
        return to_detections(np.zeros(shape, dtype=np.int32), {})
    typical = float(np.median(part.depth[own & part.valid]))
    pitch = typical / part.observation.camera.fx
    surface = compute_surface(part.depth, part.observation.camera, typical)
    boundary = upsample_map(seen.boundary, shape)[window.slices]
    patches = oversegment(np.maximum(surface.borders, boundary), own, pitch)
    whole = _merge_patches(patches, surface, seen, window, shape)
    attached = attach_border_pixels(whole, surface, own, compute_least_pixels(pitch))
    regions = keep_regions_over_table(np.where(part.valid, attached, 0), part)
    regions = merge_occluded_parts(regions, surface, part, with_vessels=False)
    regions = drop_unseen_regions(keep_objects(regions, part, by_depth=False), part)
    # Holders come before their contents: by the pixels with a reading, as those of containers are compared.
    sizes = np.bincount(regions[part.valid], minlength=int(regions.max(initial=0)) + 1)[1:]
    regions = _add_unmeasured(regions, attached, part.valid)
    regions = renumber_regions(regions, [int(k) + 1 for k in np.argsort(-sizes, kind="stable")])
    full = fill_holes(uncrop_ids(regions, window, shape))
    regions = np.where(part.valid, regions, 0)
    holders = find_containers(regions, find_rims(regions, part), part)
    return to_detections(full, holders)


def find_openings(standing: Mask, depth: DepthImage) -> Mask:
    """Find the table that is seen through handles: what is read within something that stands nearer; shapes (h, w).

    The floor of a plate, which its rim surrounds too, lies no step behind it.
    """
    parts, count = ndimage.label((depth > 0) & ~standing)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    openings = np.zeros(depth.shape, dtype=bool)
    for k, window in enumerate(ndimage.find_objects(parts), start=1):
        if sizes[k] > MAX_OPENING_SHARE * depth.size:
            continue
        wider = tuple(slice(max(side.start - RING_PX, 0), side.stop + RING_PX) for side in window)
        inside, own = parts[wider] == k, depth[wider]
        around = ndimage.binary_dilation(inside, iterations=RING_PX) & standing[wider] & (own > 0)
        nearest = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
        steps = own[nearest[0], nearest[1]][around] - own[around]
        openings[wider] |= inside & (len(steps) > 0 and float(np.median(steps)) > MIN_STEP_M)
    return openings


def _merge_patches(
    patches: IdImage, surface: Surface, seen: PicturePrediction, window: ImageWindow, shape: tuple[int, ...]
) -> IdImage:
    """Merge patches across the weakest borders by the mean strength in depth, less the net's mean logit of one object.

    Where depth is unknown the net decides alone.
    """
    known = surface.normals[..., 2] < 0
    links = build_links(patches, replace(surface, borders=np.where(known, surface.borders, FUSED_BELOW)))
    small = take_nearest(uncrop_ids(patches, window, shape), *seen.boundary.shape)
    apart = Link(0.0, 0.0)  # two that do not touch yet may do so once they grow
    for (a, b), logits, pairs in zip(*sum_affinities(seen, small), strict=True):
        link = links.get(a, {}).get(b, apart)._replace(logits=logits, pairs=pairs)
        links.setdefault(a, {})[b] = links.setdefault(b, {})[a] = link
    return merge_linked(patches, links, _measure_strength, FUSED_BELOW)


def _measure_strength(link: Link, _size_a: int, _size_b: int) -> float:
    """Measure a border's mean strength in depth, less what the net says; infinite where the two do not touch."""
    if not link.length:
        return math.inf
    return link.strength / link.length - AFFINITY_WEIGHT * link.logits / max(link.pairs, 1.0)


def _add_unmeasured(regions: IdImage, before: IdImage, measured: Mask) -> IdImage:
    """Give each pixel without a reading what most measured pixels of its region have become."""
    counts = np.zeros((int(before.max(initial=0)) + 1, int(regions.max(initial=0)) + 1), dtype=np.int64)
    np.add.at(counts, (before[measured], regions[measured]), 1)
    became = np.where(np.arange(len(counts)) > 0, counts.argmax(axis=1), 0).astype(np.int32)
    return np.where(measured | (regions > 0), regions, became[before])


def upsample_map(map_: Float32[np.ndarray, "h w"], shape: tuple[int, ...]) -> Float32[np.ndarray, "h2 w2"]:
    """Resize a map of the net to the size of the picture."""
    height, width = shape
    return np.asarray(Image.fromarray(map_).resize((width, height), Image.Resampling.BILINEAR))
