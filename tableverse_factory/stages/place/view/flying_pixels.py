"""Flying pixels: false readings along an object's outline, where sensors and filters smear depth over an edge."""

import numpy as np
from jaxtyping import Float64, Int64
from scipy import ndimage
from skimage.color import rgb2lab

from schemas.geometry import Camera, DepthImage, Mask, Picture
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.color_edges import FAINT_EDGE, blur_to_lab, measure_color_edges
from tableverse_factory.stages.place.view.object_pixels import (
    INSET_PX,
    RARITY,
    compute_color_share,
    compute_pixel_normals,
    filter_depth,
)

CORE_SHARE = 0.35  # depth of a mask's core below its outline, as a share of the deepest pixel's
MIN_OFF = 0.05  # least share of the colours beside the object that are like a flying pixel's
SAME_HUE = 6.0  # least median difference of hue between object and surroundings; below it, shade alone tells nothing
SMEARED_PX = 4
MOST_SMEARED = 0.5
RAMP_FACING = 0.25
RAMP_START_PX = 3
RAMP_PX = 12
CONTINUOUS_M = 0.01
MOSTLY = 0.6
FAINT_SHARE = 0.25  # most of the edge to the background, as a share of that to the object
MIN_TOUCHING = 0.5  # least border with the object over the rest of the outline: 0.8 and more of smears


def find_background_colors(color: Picture, own: Mask, beside: Mask) -> Mask:
    """Find the object's own pixels with the colours of the background beside it; none where the two are much alike."""
    found = np.zeros(own.shape, dtype=bool)
    inset = _measure_inset(own)
    core = inset > max(INSET_PX, CORE_SHARE * float(inset.max()))
    if not core.any() or not beside.any():
        return found
    shown = rgb2lab(color)
    if np.median(np.linalg.norm(shown[beside][:, 1:] - np.median(shown[core][:, 1:], axis=0), axis=1)) < SAME_HUE:
        return found
    on, off = compute_color_share(shown[own], shown[core]), compute_color_share(shown[own], shown[beside])
    found[own] = (off > MIN_OFF) & (RARITY * on < off)
    return ndimage.binary_opening(found) & own


def find_flying_pixels(
    background_colors: Mask, color: Picture, raw: DepthImage, own: Mask, beside: Mask, *, measured: bool
) -> Mask:
    """Find those of an object's pixels with background colours whose readings [m] were smeared.

    Sensors and their filters interpolate between an object and its background. Such pixels lie near the outline, or in
    whole patches that continue into the background: their readings without a step or, of `measured` depth, the picture
    without an edge. They are never more than half of the object.
    """
    if not background_colors.any():
        return background_colors
    at_edge = background_colors & (_measure_inset(own) <= SMEARED_PX)
    smeared = at_edge | _find_continuous_patches(background_colors, raw, beside)
    if measured:
        smeared |= _find_edgeless_patches(background_colors, color, own, beside)
    result = ndimage.binary_propagation(at_edge, mask=smeared)
    return result if result.sum() <= MOST_SMEARED * own.sum() else np.zeros_like(own)


def find_depth_ramps(raw: DepthImage, own: Mask, trusted: Mask, window: Camera) -> Mask:
    """Find trusted readings [m] near the outline on a surface seen almost edge-on: a sensor's ramp to the background.

    A real surface at such an angle tells little about the shape; a ramp is no surface.
    """
    depth = filter_depth(raw, trusted)
    cloud = backproject(depth, window)
    normals = compute_pixel_normals(cloud, depth > 0.0, np.zeros(3))
    with np.errstate(invalid="ignore", divide="ignore"):
        facing = np.abs((normals * cloud).sum(axis=-1)) / np.linalg.norm(cloud, axis=-1)
    steep = trusted & (facing < RAMP_FACING)
    at_edge = steep & ~ndimage.binary_erosion(own, iterations=RAMP_START_PX)
    near = own & ~ndimage.binary_erosion(own, iterations=RAMP_PX)
    return ndimage.binary_propagation(at_edge, mask=steep & near)


def _measure_inset(own: Mask) -> Float64[np.ndarray, "h w"]:
    return np.asarray(ndimage.distance_transform_edt(np.pad(own, 1))[1:-1, 1:-1])


def _find_continuous_patches(patches: Mask, raw: DepthImage, beside: Mask) -> Mask:
    """Find patches whose readings continue without a step along most of their border with the background."""
    labels, count = ndimage.label(patches)
    if count == 0:
        return patches
    read = beside & (raw > 0.0)
    away, nearest = ndimage.distance_transform_edt(~read, return_indices=True)
    border = patches & (away <= INSET_PX)
    flush = np.abs(raw - raw[nearest[0], nearest[1]]) < CONTINUOUS_M
    whole = np.bincount(labels[border], minlength=count + 1)
    smooth = np.bincount(labels[border & flush], minlength=count + 1)
    return ((smooth >= MOSTLY * whole) & (whole > 0))[labels] & patches


def _find_edgeless_patches(patches: Mask, color: Picture, own: Mask, beside: Mask) -> Mask:
    """Find patches of which the picture shows no edge to the background, but one to the object.

    Smeared depth lies along the object; a handle in the colours of the background touches it with its ends alone.
    """
    labels, count = ndimage.label(patches)
    lab, body = blur_to_lab(color), own & ~patches
    outer, inner = (measure_color_edges(labels, count, lab, other) for other in (beside, body))
    touching = _count_border(labels, count, body)
    outline = touching + _count_border(labels, count, ~own)
    faint = (outer <= FAINT_EDGE) & (outer <= FAINT_SHARE * inner)  # false where either is not known
    return np.concatenate([[False], faint & (touching >= MIN_TOUCHING * (outline - touching))])[labels]


def _count_border(labels: Int64[np.ndarray, "h w"], count: int, other: Mask) -> Int64[np.ndarray, " count"]:
    """Count the pixels of each label that border on others; the picture's border counts as one of the others."""
    near = ndimage.binary_dilation(np.pad(other, 1, mode="edge"))[1:-1, 1:-1]
    return np.bincount(labels[near], minlength=count + 1)[1:]
