"""Texels of textures, which repeat beyond their borders."""

import numpy as np
from jaxtyping import Float64, UInt8

from schemas.geometry import Texture

TexturePoints = Float64[np.ndarray, "n 2"]


def fold_uv(uv: TexturePoints) -> TexturePoints:
    """Fold points beyond the borders of a repeating texture back into it; those on its borders stay there."""
    return np.where((uv < 0.0) | (uv > 1.0), uv - np.floor(uv), uv)


def get_nearest_texels(texture: Texture, uv: TexturePoints) -> UInt8[np.ndarray, "n 3"]:
    """Get the texel at each point, u right and v up, in sRGB."""
    height, width = texture.picture.shape[:2]
    u, v = fold_uv(uv).T
    columns = np.clip((u * width).astype(np.int64), 0, width - 1)
    rows = np.clip(((1.0 - v) * height).astype(np.int64), 0, height - 1)
    return texture.picture[rows, columns]
