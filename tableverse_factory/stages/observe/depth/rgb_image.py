"""Picture without depth: upright pixels and the focal length from its file."""

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image

from schemas.config import ObserveConfig
from schemas.geometry import Camera, Frozen, Picture
from schemas.known_length import KnownSheet
from tableverse_factory.core.storage.untrusted import open_image, read_bytes
from tableverse_factory.sources.focal import check_field_of_view, read_exif_focal
from tableverse_factory.sources.image_file import decode_upright
from tableverse_factory.sources.known_length import check_pixels, read_known_length, rescale_pixels
from tableverse_factory.stages.observe.depth.sheet_focal import Focal, estimate_sheet_focal

MAX_SIDE_PX = 2048  # larger pictures are resized: depth models see 500 pixels, and later stages pay for the rest
USUAL_FIELD_DEG = 58.0  # angle over the longer side where nothing tells it: between phones and web cameras
FOCAL_SIGMA = 0.2  # standard deviation of the logarithm of a focal length that nothing tells


@dataclass(frozen=True, slots=True, eq=False)
class RgbImage(Frozen):
    """An upright picture, its focal length from EXIF [px] or None, and the width and height of the file's."""

    color: Picture
    exif_px: float | None
    file_size: tuple[int, int]

    def choose_focal(self, configured: float | None, known_length: str = "") -> Focal:
        """Choose the focal length for `color`: from EXIF, as configured for the file's size, by a sheet, or the usual.

        `known_length`, as JSON, may name the corners of a sheet.

        Raises:
            InputError: reason `bad_intrinsics`, if the configured one spans no angle that cameras have;
                `bad_known_length`.
        """
        (height, width), file_width = self.color.shape[:2], self.file_size[0]
        if self.exif_px is not None:
            return Focal(self.exif_px, 0.0, "exif")
        if configured is not None:
            focal = configured * width / file_width
            centered = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
            check_field_of_view(centered, "observe.focal_px")
            return Focal(focal, 0.0, "assumed")
        usual = Focal(self.get_field_px(USUAL_FIELD_DEG), FOCAL_SIGMA, "assumed")
        known = read_known_length(known_length, "known_length") if known_length else None
        if isinstance(known, KnownSheet):
            check_pixels(known, *self.file_size)
            pixels = rescale_pixels(known, self.file_size, (width, height)).pixels
            return estimate_sheet_focal(pixels, known.size_m, (width, height), usual) or usual
        return usual

    def get_field_px(self, field_deg: float) -> float:
        """Return the focal length for `color` [px] with which its longer side spans an angle."""
        return max(self.color.shape[:2]) / (2.0 * math.tan(math.radians(field_deg) / 2.0))


def read_rgb_image(uri: str, bounds: ObserveConfig) -> RgbImage:
    """Read a picture's pixels and EXIF."""
    name = uri.rsplit("/", 1)[-1]
    data = read_bytes(uri, bounds.max_file_bytes, "unreadable_color")
    color = decode_upright(data, name, bounds)
    exif_px = read_exif_focal(open_image(data, name, bounds, "unreadable_color")).px
    height, width = color.shape[:2]
    scale = min(1.0, MAX_SIDE_PX / max(width, height))
    if scale < 1.0:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        color = np.array(Image.fromarray(color).resize(size, Image.Resampling.BOX))
    return RgbImage(color, None if exif_px is None else exif_px * color.shape[1] / width, (width, height))
