"""Periodic fields on a square, of which textures are made.

Only additions, products, quotients, comparisons and roots touch the pixels: IEEE arithmetic fixes them to the last bit,
whatever the processor, the compiler or the BLAS. Nothing here calls a sine or an exponential on an array.
Every field repeats without a seam in both directions.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32

from schemas.geometry import Frozen

Field = Float32[np.ndarray, "n n"]  # Values over the square, the first row on top
Raster = Float32[np.ndarray, "n n 3"]  # sRGB in 0–255, the first row on top
Color = Float32[np.ndarray, "3"]  # sRGB in 0–255
Ids = Int32[np.ndarray, "n n"]

_SHADES = 1024
_SPLINE_GAIN = np.float32(3.6)  # Scales values in -1 to 1, smoothed by the spline, to a standard deviation of about 1


@dataclass(frozen=True, slots=True, eq=False)
class Cells(Frozen):
    """Distances of each pixel to the nearest two random points, in cells, and the nearest's number (Worley, 1996)."""

    nearest: Field
    second: Field
    ids: Ids
    count: int

    @property
    def border(self) -> Field:
        """Distance to the border between two cells, growing inwards from 0."""
        return self.second - self.nearest


def pixel_centers(size: int) -> Float32[np.ndarray, " n"]:
    """Compute the centres of the pixels of a row, over its length."""
    return ((np.arange(size) + 0.5) / size).astype(np.float32)


def pixel_grid(size: int) -> tuple[Field, Field]:
    """Compute the centres of the pixels, to the right and downwards, 0–1."""
    u: Field = np.broadcast_to(pixel_centers(size), (size, size))
    return u, u.T


def make_noise(
    rng: np.random.Generator, size: int, cells: tuple[int, int], octaves: int = 4, gain: float = 0.5
) -> Field:
    """Make random hills of mean 0 and standard deviation about 1, by a periodic cubic spline.

    The coarsest octave has `cells` to the right and downwards; each octave is twice as fine, with `gain` its weight.

    Octaves too fine for the pixels are left out, but drawn: the same seed gives the same hills at any size.
    """
    total = np.zeros((size, size), dtype=np.float32)
    weight, power = np.float32(1.0), np.float32(0.0)
    for octave in range(octaves):
        lattice = rng.random((cells[0] << octave, cells[1] << octave), dtype=np.float32) * 2 - 1
        power += weight * weight
        if octave == 0 or 2 * max(lattice.shape) <= max(size, 2 * min(lattice.shape)):
            total += weight * _upsample(np.ascontiguousarray(_upsample(lattice, size).T), size)
        weight *= np.float32(gain)
    total *= _SPLINE_GAIN / np.sqrt(power)
    return total


def _upsample(values: Float32[np.ndarray, "m k"], size: int) -> Float32[np.ndarray, "n k"]:
    """Upsample the first axis by a periodic cubic B-spline."""
    count = len(values)
    place = (np.arange(size) + 0.5) * count / size
    cell = np.floor(place).astype(np.intp)
    f = (place - cell).astype(np.float32)[:, None]
    g = 1 - f
    total: Float32[np.ndarray, "n k"] = (g * g * g / 6) * values[(cell - 1) % count]
    total += ((4 - 6 * f * f + 3 * f * f * f) / 6) * values[cell]
    total += ((4 - 6 * g * g + 3 * g * g * g) / 6) * values[(cell + 1) % count]
    total += (f * f * f / 6) * values[(cell + 2) % count]
    return total


def find_cells(rng: np.random.Generator, size: int, count: tuple[int, int], jitter: float = 1.0) -> Cells:
    """Find the cells of random points, one in each box of a grid of `count` boxes to the right and downwards.

    A jitter of 0 puts the points into the middle of their boxes, 1 anywhere within.
    """
    across, down = count
    offset = (rng.random((2, down, across), dtype=np.float32) - np.float32(0.5)) * np.float32(jitter) + np.float32(0.5)
    numbers = np.arange(across * down, dtype=np.int32).reshape(down, across)
    column, row = (np.minimum(np.arange(size) * n // size, n - 1) for n in count)
    x = (pixel_centers(size) * across - column).astype(np.float32)[None, :]
    y = (pixel_centers(size) * down - row).astype(np.float32)[:, None]
    nearest = np.full((size, size), 9.0, dtype=np.float32)
    second, ids = nearest.copy(), np.zeros((size, size), dtype=np.int32)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            rows, columns = (row + dy) % down, (column + dx) % across
            ax = x - (offset[0][rows][:, columns] + np.float32(dx))
            ay = y - (offset[1][rows][:, columns] + np.float32(dy))
            distance = ax * ax + ay * ay
            second = np.minimum(second, np.maximum(nearest, distance))
            closer = distance < nearest
            nearest = np.minimum(nearest, distance)
            ids = np.where(closer, numbers[rows][:, columns], ids)
    return Cells(np.sqrt(nearest), np.sqrt(second), ids, across * down)


def wave(turns: Field) -> Field:
    """Approximate the sine of a number of turns, -1 to 1 (Bhaskara's rational formula)."""
    t = (turns - np.floor(turns)) * 2
    second_half = t > 1
    t = np.where(second_half, t - 1, t)
    p = 4 * t * (1 - t)
    half: Field = 4 * p / (5 - p)
    return np.where(second_half, -half, half)


def take_fraction(values: Field) -> Field:
    """Take the fractional part, 0–1."""
    return values - np.floor(values)


def smoothstep(values: Field, low: float, high: float) -> Field:
    """Rise smoothly from 0 at `low` to 1 at `high`; `low` may be the larger one."""
    t = np.clip((values - np.float32(low)) / np.float32(high - low), 0, 1)
    return t * t * (3 - 2 * t)


def bell(values: Field, width: float) -> Field:
    """Peak of height 1 at 0; a half at 0.64 of `width`."""
    t = values / np.float32(width)
    p = 1 / (1 + t * t)
    return p * p


def shade_relief(height: Field, strength: float) -> Field:
    """Compute the brightness gained by a height in light from the upper left; the same at any size."""
    steep = (np.roll(height, 1, axis=0) - height) + (np.roll(height, 1, axis=1) - height)
    return np.clip(-steep * np.float32(strength * len(height) / 512), -0.6, 0.6)


def map_colors(weight: Field, colors: Sequence[Color]) -> Raster:
    """Map weights to colours, from the first at 0 to the last at 1, evenly spaced."""
    place = np.linspace(0.0, len(colors) - 1, _SHADES)
    left = np.minimum(place.astype(np.intp), len(colors) - 2)
    share = (place - left)[:, None]
    stops = np.asarray(colors, dtype=np.float64)
    table = ((1 - share) * stops[left] + share * stops[left + 1]).astype(np.float32)
    index = (np.clip(weight, 0, 1) * np.float32(_SHADES - 1)).astype(np.int32)
    return table[index]


def paint(raster: Raster, color: Color, weight: Field) -> Raster:
    """Cover a raster with a coat as thick as the weight, 0–1."""
    coat = np.clip(weight, 0, 1)[..., None]
    return raster + (color - raster) * coat


def brighten(raster: Raster, gain: Field) -> Raster:
    """Brighten by the gain: 0 changes nothing, -1 is black."""
    return raster * (1 + gain)[..., None]


def gather_wrapped(field: np.ndarray, right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Look a field up at other pixels, which wrap round. Shape of the places."""
    size = len(field)
    return field.reshape(size * size, *field.shape[2:])[(down % size) * size + right % size]
