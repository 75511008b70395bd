"""Pictures as files."""

import io

import numpy as np
from PIL import Image


def encode_png(picture: np.ndarray) -> bytes:
    """A picture as a PNG file; equal pictures give equal bytes.

    Args:
        picture: uint8. Shape (h, w, 3), sRGB, or (h, w) for grey.
    """
    out = io.BytesIO()
    Image.fromarray(picture).save(out, "PNG", compress_level=4)
    return out.getvalue()
