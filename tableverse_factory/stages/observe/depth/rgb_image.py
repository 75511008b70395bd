"""Picture without depth: upright pixels and the focal length from its file."""

from dataclasses import dataclass

import numpy as np
from PIL import Image

from schemas.config import ObserveConfig
from schemas.geometry import Frozen, Picture
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import open_image, read_bytes
from tableverse_factory.sources.image_file import decode_upright
from tableverse_factory.stages.observe.depth.focal import read_exif_focal

MAX_SIDE_PX = 2048  # larger pictures are resized: depth models see 500 pixels, and later stages pay for the rest
MAX_ASPECT = 8.0  # maximum ratio of the longer side to the shorter: no depth model was trained on narrower pictures


@dataclass(frozen=True, slots=True, eq=False)
class RgbImage(Frozen):
    """An upright picture, its focal length from EXIF [px] or None, and its size relative to the file's."""

    color: Picture
    exif_px: float | None
    scale: float

    def get_focal_px(self, configured: float | None) -> float:
        """Return the focal length for `color` [px], from EXIF or else as configured for the size of the file."""
        if self.exif_px is not None:
            return self.exif_px
        if configured is not None:
            return configured * self.scale
        raise InputError(
            "this depth model does not estimate the focal length, and the picture's EXIF holds none that fits it "
            "(FocalLengthIn35mmFilm, or FocalLength with FocalPlaneXResolution): set observe.focal_px, the focal "
            "length of these pictures in pixels, or use depth_anything_3_nested or moge_2, which estimate it",
            "no_focal_length",
        )


def read_rgb_image(uri: str, bounds: ObserveConfig) -> RgbImage:
    """Read a picture's pixels and EXIF."""
    name = uri.rsplit("/", 1)[-1]
    data = read_bytes(uri, bounds.max_file_bytes, "unreadable_color")
    color = decode_upright(data, name, bounds)
    focal = read_exif_focal(open_image(data, name, bounds, "unreadable_color"))
    height, width = color.shape[:2]
    if max(width, height) > MAX_ASPECT * min(width, height):
        raise InputError(
            f"{name} has {width} x {height} pixels: one side is more than {MAX_ASPECT:g} times the other, and no depth "
            "model knows such pictures",
            "picture_too_narrow",
        )
    scale = min(1.0, MAX_SIDE_PX / max(width, height))
    if scale < 1.0:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        color = np.array(Image.fromarray(color).resize(size, Image.Resampling.BOX))
        scale = color.shape[1] / width
    return RgbImage(color, None if focal is None else focal * scale, scale)
