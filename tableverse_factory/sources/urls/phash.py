"""Perceptual hash: nearly equal for pictures that differ in size, compression and brightness alone."""

import numpy as np
import scipy.fft
from PIL import Image

from schemas.geometry import Picture

HASH_BITS = 64
_SIDE = 32
_WAVES = sorted(((u, v) for u in range(12) for v in range(12) if u + v), key=lambda w: (w[0] ** 2 + w[1] ** 2, w))
_FREQUENCIES = np.array(_WAVES[:HASH_BITS])  # The longest waves but the mean, from the longest on. Shape (64, 2)


def compute_phash(picture: Picture) -> int:
    """Compute 64 bits of an upright picture: which of the lowest frequencies of its grey exceed their median.

    A discrete cosine transform (DCT-II) of 32 × 32 grey pixels, as in pHash (C. Zauner, 2010), with the waves taken by
    length instead of from a square. Half of the bits are set, so distances are even.
    """
    small = Image.fromarray(picture).convert("L").resize((_SIDE, _SIDE), Image.Resampling.LANCZOS)
    waves = scipy.fft.dctn(np.asarray(small, dtype=np.float64), norm="ortho")[_FREQUENCIES[:, 0], _FREQUENCIES[:, 1]]
    return int.from_bytes(np.packbits(waves > np.median(waves)).tobytes())
