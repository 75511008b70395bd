"""Choices of one texture: random numbers, and colours by lightness, chroma and hue."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from tableverse_factory.sources.textures.fields import Cells, Color, Field, Raster, find_cells, make_noise, map_colors

Choice = TypeVar("Choice")

_STEPS = (0.8812714616, 0.7766393891, 0.6844301296, 0.6031687407, 0.5315553977)
"""Inverse powers of the root of x^6 = x + 1: their multiples fill a cube of five dimensions evenly (Roberts, 2018)."""


@dataclass(frozen=True, slots=True)
class TextureSampler:
    """Random choices of one texture.

    Attributes:
        number: Number of the texture in its family: `spread` tells members apart by it.
        start: Where the family starts to spread, so that families do not all begin with the same colour.
    """

    rng: np.random.Generator
    number: int
    size: int
    start: float = 0.5

    def spread(self, dimension: int) -> float:
        """Get a number in 0–1; the members of a family fill each dimension evenly."""
        return ((dimension + 1) * self.start + self.number * _STEPS[dimension]) % 1.0

    def choose(self, options: Sequence[Choice], dimension: int = 2) -> Choice:
        """Choose an option by `spread`."""
        return options[int(len(options) * self.spread(dimension))]

    def color(
        self, lightness: tuple[float, float], chroma: tuple[float, float], hue: tuple[float, float] = (0.0, 1.0)
    ) -> Color:
        """Choose a colour (`oklch`) by `spread`, each coordinate from its start over its extent."""
        return oklch(*(low + extent * self.spread(k) for (low, extent), k in ((lightness, 1), (chroma, 3), (hue, 0))))

    def between(self, low: float, high: float) -> float:
        """Draw a number."""
        return low + (high - low) * float(self.rng.random())

    def whole(self, low: int, high: int) -> int:
        """Draw a whole number, both ends included."""
        return int(self.rng.integers(low, high + 1))

    def chance(self, probability: float) -> bool:
        """Draw whether something happens."""
        return float(self.rng.random()) < probability

    def pick(self, options: Sequence[Choice]) -> Choice:
        """Draw an option."""
        return options[self.whole(0, len(options) - 1)]

    def near(self, color: Color, far: float = 10.0) -> Color:
        """Draw a similar colour: lighter or darker by up to `far`, and half of that off in each channel."""
        shift = self.rng.random(4) * 2 - 1
        return np.clip(np.rint(color + far * shift[0] + 0.5 * far * shift[1:]), 3, 252).astype(np.float32)

    def each(self, count: int, far: float) -> np.ndarray:
        """Draw a number from -far to far for each cell or board. Shape (count,)."""
        return (self.rng.random(count, dtype=np.float32) * 2 - 1) * np.float32(far)

    def noise(self, cells: tuple[int, int], octaves: int = 4, gain: float = 0.5) -> Field:
        """Draw noise (`make_noise`)."""
        return make_noise(self.rng, self.size, cells, octaves, gain)

    def cells(self, across: int, down: int, jitter: float = 1.0) -> Cells:
        """Draw cells (`find_cells`)."""
        return find_cells(self.rng, self.size, (across, down), jitter)

    def fill(self, color: Color) -> Raster:
        """Fill the square with one colour."""
        return np.broadcast_to(color, (self.size, self.size, 3))


def map_shades(weight: Field, color: Color, dark: float, light: float) -> Raster:
    """Map weights 0–1 to a colour from `dark` to `light` times itself."""
    return map_colors(weight, (scale_color(color, dark), color, scale_color(color, light)))


def parse_hex(code: str) -> Color:
    """Parse a colour as in HTML, without the sign: `c8a070`."""
    return np.array([int(code[i : i + 2], 16) for i in (0, 2, 4)], dtype=np.float32)


def oklch(lightness: float, chroma: float, hue: float) -> Color:
    """Convert a colour of Oklab (Ottosson) to whole steps of sRGB.

    Args:
        lightness: 0 black to 1 white.
        chroma: 0 grey to about 0.3; less of it near white and black, where screens and dyes have none to give.
        hue: In turns; 0.08 red, 0.3 yellow, 0.4 green, 0.72 blue.
    """
    chroma *= min(1.0, 3.2 * (1.0 - lightness), 3.5 * lightness)
    a, b = chroma * math.cos(2 * math.pi * hue), chroma * math.sin(2 * math.pi * hue)
    long = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3
    medium = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3
    short = (lightness - 0.0894841775 * a - 1.2914855480 * b) ** 3
    linear = (
        4.0767416621 * long - 3.3077115913 * medium + 0.2309699292 * short,
        -1.2684380046 * long + 2.6097574011 * medium - 0.3413193965 * short,
        -0.0041960863 * long - 0.7034186147 * medium + 1.7076147010 * short,
    )
    return np.array([round(255 * _encode_srgb(min(max(c, 0.0), 1.0))) for c in linear], dtype=np.float32)


def scale_color(color: Color, factor: float) -> Color:
    """Make a colour darker (below 1) or lighter."""
    return np.clip(np.rint(color * factor), 0, 255).astype(np.float32)


def _encode_srgb(linear: float) -> float:
    return float(12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055)
