"""Picture without depth: upright pixels and the focal length from its file."""

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image

from schemas.config import ObserveConfig
from schemas.geometry import Camera, Frozen, Picture
from schemas.observation import IntrinsicsSource
from tableverse_factory.core.storage.untrusted import open_image, read_bytes
from tableverse_factory.sources.focal import check_field_of_view, read_exif_focal
from tableverse_factory.sources.image_file import decode_upright

MAX_SIDE_PX = 2048  # larger pictures are resized: depth models see 500 pixels, and later stages pay for the rest
USUAL_FIELD_DEG = 58.0  # angle over the longer side where nothing tells it: between phones and web cameras


@dataclass(frozen=True, slots=True, eq=False)
class RgbImage(Frozen):
    """An upright picture, its focal length from EXIF [px] or None, and its size relative to the file's."""

    color: Picture
    exif_px: float | None
    scale: float

    @property
    def intrinsics_source(self) -> IntrinsicsSource:
        """Origin of the focal length."""
        return "assumed" if self.exif_px is None else "exif"

    def get_focal_px(self, configured: float | None) -> float:
        """Return the focal length for `color` [px]: from EXIF, as configured for the file's size, or the usual one.

        Raises:
            InputError: reason `bad_intrinsics`, if the configured one spans no angle that cameras have.
        """
        if self.exif_px is not None:
            return self.exif_px
        if configured is not None:
            focal, (height, width) = configured * self.scale, self.color.shape[:2]
            centered = Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
            check_field_of_view(centered, "observe.focal_px")
            return focal
        return self.get_field_px(USUAL_FIELD_DEG)

    def get_field_px(self, field_deg: float) -> float:
        """Return the focal length for `color` [px] with which its longer side spans an angle."""
        return max(self.color.shape[:2]) / (2.0 * math.tan(math.radians(field_deg) / 2.0))


def read_rgb_image(uri: str, bounds: ObserveConfig) -> RgbImage:
    """Read a picture's pixels and EXIF."""
    name = uri.rsplit("/", 1)[-1]
    data = read_bytes(uri, bounds.max_file_bytes, "unreadable_color")
    color = decode_upright(data, name, bounds)
    focal = read_exif_focal(open_image(data, name, bounds, "unreadable_color")).px
    height, width = color.shape[:2]
    scale = min(1.0, MAX_SIDE_PX / max(width, height))
    if scale < 1.0:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        color = np.array(Image.fromarray(color).resize(size, Image.Resampling.BOX))
        scale = color.shape[1] / width
    return RgbImage(color, None if focal is None else focal * scale, scale)
