"""Readings along an object's outline that no surface gave: sensors and filters smear depth over the edges of things."""

import numpy as np
from scipy import ndimage
from skimage.color import rgb2lab

from schemas.geometry import Camera, DepthImage, Mask, Picture
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.stages.place.view.color_model import INSET_PX, RARITY, compute_color_share
from tableverse_factory.stages.place.view.object_pixels import compute_pixel_normals, filter_depth

CORE_SHARE = 0.35
"""The core of a mask is farther from its outline than this share of the farthest pixel."""
MIN_OFF = 0.05
"""Share of the colours beside the object that has to be like a pixel's before it counts as smeared."""
SAME_HUE = 6.0
"""Where most of the surroundings differ less than this in hue from the object, shade alone tells nothing."""
SMEARED_PX = 4
MOST_SMEARED = 0.5
RAMP_FACING = 0.25
RAMP_START_PX = 3
RAMP_PX = 12
CONTINUOUS_M = 0.01
MOSTLY = 0.6


def find_flying_pixels(color: Picture, raw: DepthImage, own: Mask, beside: Mask) -> Mask:
    """Which of the object's pixels have the colours of what lies beside it: their readings were smeared over its edge.

    Sensors and their filters interpolate between a thing and what lies behind it. Taken for pixels like these are
    those near the outline, and whole patches whose readings run on without a step into what lies beside; never more
    than half of the object.

    Args:
        color: Of the window.
        raw: Depth of the window [m].
        own: The object's pixels.
        beside: Pixels of the table and of what nobody claims.
    """
    nothing = np.zeros(own.shape, dtype=bool)
    inset = ndimage.distance_transform_edt(np.pad(own, 1))[1:-1, 1:-1]
    core = inset > max(INSET_PX, CORE_SHARE * float(inset.max()))
    if not core.any() or not beside.any():
        return nothing
    shown = rgb2lab(color)
    if np.median(np.linalg.norm(shown[beside][:, 1:] - np.median(shown[core][:, 1:], axis=0), axis=1)) < SAME_HUE:
        return nothing
    foreign = nothing.copy()
    on, off = compute_color_share(shown[own], shown[core]), compute_color_share(shown[own], shown[beside])
    foreign[own] = (off > MIN_OFF) & (RARITY * on < off)
    foreign = ndimage.binary_opening(foreign) & own
    at_edge = foreign & (inset <= SMEARED_PX)
    result = ndimage.binary_propagation(
        at_edge, mask=foreign & (at_edge | _find_continuous_patches(foreign, raw, beside))
    )
    return result if result.sum() <= MOST_SMEARED * own.sum() else nothing


def find_depth_ramps(raw: DepthImage, own: Mask, trusted: Mask, window: Camera) -> Mask:
    """Readings near the outline on a surface seen almost edge-on: a sensor's ramp from the object to what lies behind.

    A real surface at such an angle says little about the shape; a ramp is no surface at all.

    Args:
        raw: Depth of the window [m].
        own: The object's pixels.
        trusted: Those with a reading that survived the denoising.
        window: Intrinsics of the window.
    """
    depth = filter_depth(raw, trusted)
    cloud = backproject(depth, window)
    normals = compute_pixel_normals(cloud, depth > 0.0, np.zeros(3))
    with np.errstate(invalid="ignore", divide="ignore"):
        facing = np.abs((normals * cloud).sum(axis=-1)) / np.linalg.norm(cloud, axis=-1)
    steep = trusted & (facing < RAMP_FACING)
    at_edge = steep & ~ndimage.binary_erosion(own, iterations=RAMP_START_PX)
    near = own & ~ndimage.binary_erosion(own, iterations=RAMP_PX)
    ramp: Mask = ndimage.binary_propagation(at_edge, mask=steep & near)
    return ramp


def _find_continuous_patches(patches: Mask, raw: DepthImage, beside: Mask) -> Mask:
    """Those patches whose readings go on with less than a step along most of their border with what lies beside."""
    labels, count = ndimage.label(patches)
    if count == 0:
        return patches
    read = beside & (raw > 0.0)
    away, nearest = ndimage.distance_transform_edt(~read, return_indices=True)
    border = patches & (away <= INSET_PX)
    flush = np.abs(raw - raw[nearest[0], nearest[1]]) < CONTINUOUS_M
    whole = np.bincount(labels[border], minlength=count + 1)
    smooth = np.bincount(labels[border & flush], minlength=count + 1)
    runs: Mask = ((smooth >= MOSTLY * whole) & (whole > 0))[labels] & patches
    return runs
