"""PNG encoding."""

import io

import numpy as np
from PIL import Image


def encode_png(picture: np.ndarray | Image.Image, compress_level: int = 4) -> bytes:
    """Encode a picture as PNG; equal pictures give equal bytes.

    Args:
        picture: uint8, shape (h, w, 3) sRGB or (h, w) grey; uint16, shape (h, w); or an image of Pillow's.
        compress_level: From 0, fast, to 9, small.
    """
    image = picture if isinstance(picture, Image.Image) else Image.fromarray(picture)
    out = io.BytesIO()
    image.save(out, "PNG", compress_level=compress_level)
    return out.getvalue()
