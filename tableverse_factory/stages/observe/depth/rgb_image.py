"""A picture without depth: its pixels the right way up, and the focal length that its file tells."""

from dataclasses import dataclass

import numpy as np
from PIL import Image

from schemas.config import ObserveConfig
from schemas.geometry import Frozen, Picture
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import open_picture, read_bytes
from tableverse_factory.sources.image_file import picture_of
from tableverse_factory.stages.observe.depth.focal import exif_focal

MAX_SIDE_PX = 2048
"""Longer side at which pictures go on: depth models see 500 pixels, and every stage after pays for each of the rest."""

MAX_ASPECT = 8.0
"""Of the longer side to the shorter: no camera makes narrower pictures, and no depth model was trained on them."""


@dataclass(frozen=True, slots=True, eq=False)
class RgbImage(Frozen):
    """A bare picture, at most `MAX_SIDE_PX` on its longer side.

    Attributes:
        color: Shape (h, w, 3) sRGB.
        exif_px: Focal length by its EXIF, for `color` [px]; None where it tells none.
        scale: Size of `color` over that of the file.
    """

    color: Picture
    exif_px: float | None
    scale: float

    def focal_px(self, configured: float | None) -> float:
        """Focal length for `color` [px]: by the EXIF, which is about this picture, else as configured for all.

        Args:
            configured: `observe.focal_px`, for the file's own size.

        Raises:
            InputError: `no_focal_length`, saying how to give it.
        """
        if self.exif_px is not None:
            return self.exif_px
        if configured is not None:
            return configured * self.scale
        raise InputError(
            "this depth model does not tell the focal length, and the picture's EXIF holds none that fits it "
            "(FocalLengthIn35mmFilm, or FocalLength with FocalPlaneXResolution): give observe.focal_px, the focal "
            "length of these pictures in their pixels, or take depth_anything_3_nested or moge_2, which estimate it",
            "no_focal_length",
        )


def read_photograph(uri: str, bounds: ObserveConfig) -> RgbImage:
    """Reads a picture once, for its pixels and its EXIF.

    Raises:
        InputError: `picture_too_narrow`, or as `bare_pictures.read_picture`.
    """
    name = uri.rsplit("/", 1)[-1]
    data = read_bytes(uri, bounds.max_file_bytes, "unreadable_color")
    color = picture_of(data, name, bounds)
    focal = exif_focal(open_picture(data, name, bounds, "unreadable_color"))
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
