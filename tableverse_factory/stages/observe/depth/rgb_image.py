"""Picture without depth: upright pixels and the focal length from its file."""

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image

from schemas.config import ObserveConfig
from schemas.geometry import Camera, Frozen, Picture
from schemas.known_length import KnownSheet, parse_known_length
from schemas.observation import IntrinsicsSource
from tableverse_factory.core.storage.untrusted import open_image, read_bytes
from tableverse_factory.sources.focal import check_field_of_view, read_exif_focal
from tableverse_factory.sources.image_file import decode_upright
from tableverse_factory.sources.known_length import check_pixels, rescale_pixels
from tableverse_factory.stages.observe.depth.sheet_focal import SheetFocal, estimate_sheet_focal

MAX_SIDE_PX = 2048  # larger pictures are resized: depth models see 500 pixels, and later stages pay for the rest
USUAL_FIELD_DEG = 58.0  # angle over the longer side where nothing tells it: between phones and web cameras
FOCAL_SIGMA = 0.2  # standard deviation of the logarithm of a focal length that nothing tells


@dataclass(frozen=True, slots=True, eq=False)
class RgbImage(Frozen):
    """An upright picture with its focal length.

    Attributes:
        focal_px: For `color` [px]: from EXIF, as configured, from a known sheet, or the usual one.
        focal_sigma: Standard deviation of its logarithm; 0 where it is told.
    """

    color: Picture
    focal_px: float
    focal_sigma: float
    intrinsics_source: IntrinsicsSource

    @property
    def is_guessed(self) -> bool:
        """Whether nothing tells the focal length."""
        return self.intrinsics_source == "assumed" and self.focal_sigma > 0.0

    def get_field_px(self, field_deg: float) -> float:
        """Return the focal length for `color` [px] with which its longer side spans an angle."""
        return compute_field_px(self.color.shape, field_deg)


def compute_field_px(shape: tuple[int, ...], field_deg: float) -> float:
    """Compute the focal length with which the longer side of a picture of `shape` spans an angle [px]."""
    return max(shape[:2]) / (2.0 * math.tan(math.radians(field_deg) / 2.0))


def read_rgb_image(uri: str, bounds: ObserveConfig, known_length: str = "") -> RgbImage:
    """Read a picture's pixels and its focal length; `known_length`, as JSON, may name a sheet that tells it.

    Raises:
        InputError: reason `bad_intrinsics`, if `observe.focal_px` spans no angle that cameras have, or
            `bad_known_length`.
    """
    name = uri.rsplit("/", 1)[-1]
    data = read_bytes(uri, bounds.max_file_bytes, "unreadable_color")
    color = decode_upright(data, name, bounds)
    exif_px = read_exif_focal(open_image(data, name, bounds, "unreadable_color")).px
    height, width = color.shape[:2]
    scale = min(1.0, MAX_SIDE_PX / max(width, height))
    if scale < 1.0:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        color = np.array(Image.fromarray(color).resize(size, Image.Resampling.BOX))
        scale = color.shape[1] / width
    if exif_px is not None:
        return RgbImage(color, exif_px * scale, 0.0, "exif")
    if bounds.focal_px is not None:
        _check_configured(bounds.focal_px, width, height)
        return RgbImage(color, bounds.focal_px * scale, 0.0, "assumed")
    usual = SheetFocal(compute_field_px(color.shape, USUAL_FIELD_DEG), FOCAL_SIGMA)
    known = parse_known_length(known_length) if known_length else None
    if isinstance(known, KnownSheet):
        check_pixels(known, width, height)
        seen = color.shape[1], color.shape[0]
        pixels = rescale_pixels(known, (width, height), seen).pixels
        told = estimate_sheet_focal(pixels, known.size_m, seen, usual)
        if told is not None:
            return RgbImage(color, *told, "sheet")
    return RgbImage(color, *usual, "assumed")


def _check_configured(focal_px: float, width: int, height: int) -> None:
    centered = Camera(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, width, height)
    check_field_of_view(centered, "observe.focal_px")
