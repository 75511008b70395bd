"""Texture of the exported table: a quiet procedural one in the colour that the picture shows."""

import numpy as np
from PIL import Image

from schemas.geometry import Picture
from tableverse_factory.core.memoize import memoize_by_content
from tableverse_factory.core.png import encode_png
from tableverse_factory.sources.textures.catalogue import make_texture, parse_texture_seed

# Texture families of most real tables.
QUIET = (
    "planks", "butcher_block", "veneer", "plywood", "laminate", "lacquer", "plaster", "linen", "marble", "concrete",
)  # fmt: skip
MEMBERS = 36  # of each family; to draw from more would change every table
SIDE_PX = 384
PALETTE = 64  # number of colours: few keep the file to tens of kB without visible steps
MAX_SPREAD = 12.0  # most standard deviation of each channel [levels], so that the mean colour represents the table
MAX_SHARE = 0.1  # the same as a share of the channel's mean: on dark wood, the spread of a light table would glow
BOLDEST = 3.0  # clip of each channel [standard deviations]: tinted veins of a dark stone would glow
_SKETCH_PX = 32
REMEMBERED_BYTES = 64 * 1024  # the mean colour of every member


def draw_tabletop_texture(rng: np.random.Generator, color: tuple[int, int, int]) -> bytes:
    """Draw a tile of a table-top whose mean sRGB is `color`, as a PNG file.

    Of one random member of each quiet family, the nearest in colour is tinted to match.
    """
    numbers = rng.integers(0, MEMBERS, len(QUIET))
    seeds = [parse_texture_seed(f"{family}-{number}") for family, number in zip(QUIET, numbers, strict=True)]
    wanted = np.array(color, dtype=np.float64)
    gaps = [float(((_compute_sketch_mean(seed) - wanted) ** 2).sum()) for seed in seeds]
    tile = _tint(make_texture(seeds[int(np.argmin(gaps))], SIDE_PX), wanted)
    few = Image.fromarray(tile).quantize(PALETTE, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    return encode_png(few, compress_level=6)


def _tint(picture: Picture, wanted: np.ndarray) -> Picture:
    """Scale each channel to the wanted mean and soften bold patterns; values out of range are clipped."""
    gain = np.maximum(wanted, 1.0) / np.maximum(_compute_mean(picture), 1.0)
    most = np.minimum(MAX_SPREAD, MAX_SHARE * np.maximum(wanted, 1.0))
    calm = min(1.0, float((most / np.maximum(gain * np.std(picture, axis=(0, 1)), 1e-9)).min()))
    shown = np.arange(256)[:, None] * (gain * calm) + (1.0 - calm) * wanted
    near = np.clip(shown, wanted - BOLDEST * most, wanted + BOLDEST * most)
    return np.rint(np.clip(near, 0, 255)).astype(np.uint8)[picture, np.arange(3)]


@memoize_by_content(REMEMBERED_BYTES)
def _compute_sketch_mean(seed: int) -> np.ndarray:
    return _compute_mean(make_texture(seed, _SKETCH_PX))


def _compute_mean(picture: Picture) -> np.ndarray:
    return picture.reshape(-1, 3).sum(axis=0, dtype=np.int64) / (picture.size // 3)
