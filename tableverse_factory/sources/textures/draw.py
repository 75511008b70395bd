"""What one texture draws: random numbers, and colours by lightness, chroma and hue."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from tableverse_factory.sources.textures.fields import Color

Choice = TypeVar("Choice")

_STEPS = (0.8812714616, 0.7766393891, 0.6844301296, 0.6031687407, 0.5315553977)
"""Inverse powers of the root of x^6 = x + 1: their multiples fill a cube of five dimensions evenly (Roberts, 2018)."""


@dataclass(frozen=True, slots=True)
class Draw:
    """The choices of one texture.

    Attributes:
        rng: For all that is merely random.
        number: Which member of its family: members spread evenly over what tells them apart.
        start: Where the family starts to spread, so that not all of them begin with the same colour.
    """

    rng: np.random.Generator
    number: int
    start: float = 0.5

    def spread(self, dimension: int) -> float:
        """A number in 0–1 that the members of a family fill evenly, each dimension on its own."""
        return ((dimension + 1) * self.start + self.number * _STEPS[dimension]) % 1.0

    def between(self, low: float, high: float) -> float:
        """A random number."""
        return low + (high - low) * float(self.rng.random())

    def whole(self, low: int, high: int) -> int:
        """A random whole number, both ends included."""
        return int(self.rng.integers(low, high + 1))

    def chance(self, probability: float) -> bool:
        """Whether it happens."""
        return float(self.rng.random()) < probability

    def pick(self, options: Sequence[Choice]) -> Choice:
        """One of them."""
        return options[self.whole(0, len(options) - 1)]

    def near(self, color: Color, far: float = 10.0) -> Color:
        """A colour like it: lighter or darker, and a little off in each channel."""
        shift = self.rng.random(4) * 2 - 1
        moved: Color = np.clip(np.rint(color + far * shift[0] + 0.5 * far * shift[1:]), 3, 252).astype(np.float32)
        return moved


def rgb(code: str) -> Color:
    """A colour written as in HTML, without the sign: `c8a070`."""
    return np.array([int(code[i : i + 2], 16) for i in (0, 2, 4)], dtype=np.float32)


def oklch(lightness: float, chroma: float, hue: float) -> Color:
    """A colour by how it is seen (Ottosson's Oklab), in whole steps of sRGB.

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
    return np.array([round(255 * _encoded(min(max(c, 0.0), 1.0))) for c in linear], dtype=np.float32)


def shaded(color: Color, factor: float) -> Color:
    """The colour darker (below 1) or lighter."""
    return np.clip(np.rint(color * factor), 0, 255).astype(np.float32)


def _encoded(linear: float) -> float:
    return float(12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055)
