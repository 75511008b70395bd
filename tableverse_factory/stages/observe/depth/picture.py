"""Depth of a bare picture by the net of this package, which also says whether a table-top is shown, and where."""

import math
from dataclasses import replace

import numpy as np

from schemas.config import Config, ObserveConfig
from schemas.geometry import Camera
from schemas.manifest import ImageRow
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.models.picture.predict import PicturePrediction, predict_picture
from tableverse_factory.sources.capture import Capture
from tableverse_factory.stages.observe.depth.estimate import DepthEstimate, build_capture, create_centered_camera
from tableverse_factory.stages.observe.depth.rgb_image import RgbImage, read_rgb_image

SIGMA_FACTOR = 1.15  # 68 % of 28 photographs lie within so many deviations of the net, which knows renders alone
# Only narrower ones: a picture without its EXIF was often cropped, and a crop never widens the field of view. The net's
# logit for a table is highest near the true field: on 28 photographs its focal length is off by 16 % in the root mean
# square, and that of 58 degrees by 24 %.
NARROWER_FIELDS_DEG = (46.0, 34.0)
UNSURE_PROBABILITY = 0.5  # from which a picture gets these looks, which cost as much as the first each


def estimate_picture_depth(item: ImageRow, config: Config) -> Capture:
    """Estimate depth; the focal length is as `RgbImage.choose_focal` tells it.

    Where it is a guess, and the net is unsure of the table, narrower fields of view are tried, and the one with which
    it is surest is taken: a wrong field distorts what it sees.

    Raises:
        AnswerInvalidError: reasons `no_table`, `table_out_of_bounds`.
    """
    bounds, photo = config.observe, read_rgb_image(item.uri, config.observe)
    focal = photo.choose_focal(bounds.focal_px, item.known_length)
    tried = [_predict(photo, focal.px, bounds)]
    if focal.is_guessed and UNSURE_PROBABILITY <= tried[0][1].table_probability < bounds.min_table_probability:
        tried += [_predict(photo, photo.get_field_px(field), bounds) for field in NARROWER_FIELDS_DEG]
    camera, found = max(tried, key=lambda each: each[1].table_probability)
    source = focal.source if camera is tried[0][0] else "model"
    check_table(found, bounds)
    capture = build_capture(photo.color, DepthEstimate(found.depth, found.camera, intrinsics_source=source), bounds)
    sigma = math.hypot(SIGMA_FACTOR * found.scale_sigma, focal.sigma)  # the scale grows with the focal length
    return replace(capture, camera=camera, scale_sigma=sigma)


def _predict(photo: RgbImage, focal_px: float, bounds: ObserveConfig) -> tuple[Camera, PicturePrediction]:
    camera = create_centered_camera(focal_px, photo.color.shape, photo.color.shape)
    return camera, predict_picture(photo.color, camera, weights=bounds.depth_weights)


def check_table(found: PicturePrediction, bounds: ObserveConfig) -> None:
    """Raise `AnswerInvalidError` if the net sees no table-top, or one that no camera stands so to."""
    if found.table_probability < bounds.min_table_probability:
        raise AnswerInvalidError(
            f"that the picture shows a table-top has a probability of {found.table_probability:.2f}, under "
            f"observe.min_table_probability = {bounds.min_table_probability:g}",
            "no_table",
        )
    right, down, forward = found.normal
    steepness = float(np.degrees(np.arcsin(np.clip(-forward, -1.0, 1.0))))
    roll = float(np.degrees(np.arctan2(abs(right), np.hypot(down, forward))))
    low, high = bounds.table_distance_m
    if not (low <= found.distance_m <= high and steepness >= bounds.min_view_deg and roll <= bounds.max_roll_deg):
        raise AnswerInvalidError(
            f"the table's plane would be {found.distance_m:.2f} m from the camera (observe.table_distance_m = {low:g} "
            f"to {high:g}), seen {round(steepness)}° down (observe.min_view_deg = {bounds.min_view_deg:g}) and tilted "
            f"sideways by {round(roll)}° (observe.max_roll_deg = {bounds.max_roll_deg:g})",
            "table_out_of_bounds",
        )
