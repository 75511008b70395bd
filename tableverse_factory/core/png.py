"""PNG encoding."""

import io

import numpy as np
from PIL import Image


def encode_png(picture: np.ndarray | Image.Image, compress_level: int = 4) -> bytes:
    """Encode uint8 (h, w, 3) sRGB or (h, w), or uint16 (h, w), as PNG; equal pictures give equal bytes."""
    image = picture if isinstance(picture, Image.Image) else Image.fromarray(picture)
    out = io.BytesIO()
    image.save(out, "PNG", compress_level=compress_level)
    return out.getvalue()
