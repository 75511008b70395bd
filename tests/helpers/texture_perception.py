"""How far apart two textures look: colours, and how much they change in which direction at which distance.

The unit is that of CIELAB's ΔE, in which about 2.3 is a difference just seen between two patches side by side (Mahy,
1994). Shifting a texture round its square, by whole pixels of the size of comparison, changes nothing.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Picture
from tableverse_factory.core.errors import InputError

MIN_DISTANCE = 2.3
"""No two of the catalogue's textures are nearer."""

SIDE = 128
"""Textures are compared at this size: of a tile of 0.6 m, 5 mm."""

_SHARES = (np.arange(12) + 0.5) / 12
_STEPS = (1, 2, 4, 8, 16)
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))

_TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
_WHITE = np.array([0.95047, 1.0, 1.08883])

Descriptor = Float64[np.ndarray, " 56"]


def descriptor(picture: Picture) -> Descriptor:
    """What a person takes in of a square picture: differences of descriptors have the length of the distance seen.

    36 numbers are quantiles of L*, a* and b*, so that their part of the distance is the root mean square difference of
    colours sorted by channel. 20 are the root mean square contrast of L* between pixels 1, 2, 4, 8 and 16 apart to the
    right, downwards and along both diagonals, each at half weight.

    Raises:
        InputError: if the picture is not square, or its side is no multiple of `SIDE`.
    """
    if picture.ndim != 3 or picture.shape[0] != picture.shape[1] or picture.shape[0] % SIDE:
        raise InputError(f"a picture of shape {picture.shape}: give a square one, its side a multiple of {SIDE}")
    lab = cielab(_shrunk(picture))
    quantiles = np.quantile(lab.reshape(-1, 3), _SHARES, axis=0).T.ravel() / np.sqrt(len(_SHARES))
    light = lab[..., 0]
    contrasts = [
        np.sqrt(np.mean((light - np.roll(light, (down * step, right * step), axis=(0, 1))) ** 2))
        for step in _STEPS
        for down, right in _DIRECTIONS
    ]
    return np.concatenate([quantiles, 0.5 * np.array(contrasts)])


def distance(a: Picture, b: Picture) -> float:
    """How far apart two square pictures look [ΔE].

    Raises:
        InputError: as `descriptor`.
    """
    return float(np.linalg.norm(descriptor(a) - descriptor(b)))


def nearest_distances(descriptors: Sequence[Descriptor]) -> tuple[Float64[np.ndarray, " n"], np.ndarray]:
    """Distance of each to the nearest other, and which one that is."""
    points = np.asarray(descriptors)
    squares = (points**2).sum(axis=1)
    gaps = np.maximum(squares[:, None] + squares[None, :] - 2 * points @ points.T, 0.0)
    np.fill_diagonal(gaps, np.inf)
    partner = gaps.argmin(axis=1)
    return np.linalg.norm(points - points[partner], axis=1), partner


def cielab(picture: np.ndarray) -> np.ndarray:
    """Colours in sRGB, 0–255, as CIELAB under D65. Same shape."""
    c = picture / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    t = linear @ _TO_XYZ.T / _WHITE
    f = np.where(t > 216 / 24389, np.cbrt(t), (24389 / 27 * t + 16) / 116)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    lab: np.ndarray = np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)
    return lab


def _shrunk(picture: Picture) -> np.ndarray:
    block = len(picture) // SIDE
    means: np.ndarray = picture.reshape(SIDE, block, SIDE, block, 3).mean(axis=(1, 3))
    return means
