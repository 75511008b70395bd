"""Bare picture: upright, of one frame, opaque, in colours that need no guess."""

import struct
import warnings

from PIL import Image

from schemas.config import ObserveConfig
from schemas.geometry import Picture
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import decode_image, open_image, read_bytes

_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")
"""Pillow's modes that convert to 8-bit sRGB. CMYK needs its printer's profile; 16-bit grey would clip."""

MIN_SIDE_PX = 16  # nothing is seen in less
MAX_ASPECT = 8.0  # maximum ratio of the longer side to the shorter: no depth model was trained on narrower pictures
_ORIENTATION = 0x0112  # EXIF tag
_TRANSPOSE_BY_ORIENTATION = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


def read_image(uri: str, bounds: ObserveConfig) -> Picture:
    """Read a bare picture as sRGB, turned upright as its EXIF says. Shape (h, w, 3)."""
    return decode_upright(read_bytes(uri, bounds.max_file_bytes, "unreadable_color"), uri.rsplit("/", 1)[-1], bounds)


def decode_upright(data: bytes, name: str, bounds: ObserveConfig) -> Picture:
    """Decode the bytes of a bare picture, as `read_image` does.

    Raises:
        InputError: reasons `unreadable_color`, `picture_too_large`, `picture_too_small`, `picture_too_narrow`,
            `animated_picture`, `unsupported_pixels`, `transparent_picture`.
    """
    image = open_image(data, name, bounds, "unreadable_color")
    _check_shape(name, *image.size)
    frames = getattr(image, "n_frames", 1)
    if frames > 1 and image.format != "MPO":  # phones put a preview or a depth behind the photo: its first frame counts
        raise InputError(f"{name} has {frames} frames: give one picture", "animated_picture")
    if image.mode not in _MODES:
        problem = f"{name} has pixels of mode {image.mode!r}: give 8-bit colour or grey (sRGB)"
        raise InputError(problem, "unsupported_pixels")
    if image.has_transparency_data:
        alpha = decode_image(image, name, "RGBA", "unreadable_color")[..., 3]
        if (alpha < 255).any():
            share = f"{(alpha < 255).mean():.0%} of its pixels"
            raise InputError(f"{name} is transparent in {share}: a photo has no holes", "transparent_picture")
    decode_image(image, name, None, "unreadable_color")  # before its EXIF, which may stand behind the pixels
    turned = _TRANSPOSE_BY_ORIENTATION.get(_read_orientation(image))
    return decode_image(image if turned is None else image.transpose(turned), name, "RGB", "unreadable_color")


def _check_shape(name: str, width: int, height: int) -> None:
    shorter, longer = sorted((width, height))
    if shorter < MIN_SIDE_PX:
        problem = f"{name} is {width} x {height} pixels: give at least {MIN_SIDE_PX} on each side"
        raise InputError(problem, "picture_too_small")
    if longer > MAX_ASPECT * shorter:
        problem = f"{name} is {width} x {height} pixels: crop it, one side is at most {MAX_ASPECT:g} times the other"
        raise InputError(problem, "picture_too_narrow")


def _read_orientation(image: Image.Image) -> int:
    """Read the EXIF orientation; 1 (upright) where there is none that can be read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # Pillow's, about notes that are cut off
            value = image.getexif().get(_ORIENTATION, 1)
    except (OSError, SyntaxError, ValueError, OverflowError, LookupError, TypeError, AttributeError, struct.error):
        return 1  # the pixels are sound: a broken note beside them says nothing
    return value if isinstance(value, int) else 1
