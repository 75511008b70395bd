"""Materials of things, tables and rooms: rows of the tracer's table."""

from dataclasses import dataclass

import numpy as np

from tableverse_factory.evaluation.training.picture.columns import Material
from tableverse_factory.evaluation.training.picture.patterns import FACES, Color, pick_color, pick_wood_color

PLAIN, BETWEEN, TINTED, TEXTURED = 0.0, 1.0, 2.0, 3.0  # blends of colours and texture
TILED, BOXED, WRAPPED = 0.0, 1.0, 2.0  # mappings of a texture
PRINTED_SHARE = 0.4
CLEAR_SHARE = 0.04
BAND_SHARE = 0.28


@dataclass(frozen=True, slots=True)
class TextureBook:
    """How many textures there are: printed packages, `FACES` each, come first."""

    packages: int
    patterns: int

    @property
    def count(self) -> int:
        """Number of textures."""
        return FACES * self.packages + self.patterns

    def pick_pattern(self, rng: np.random.Generator) -> int:
        """Pick a texture that is no package's."""
        return FACES * self.packages + int(rng.integers(self.patterns))

    def pick_package(self, rng: np.random.Generator) -> int:
        """Pick the first face of a package."""
        return FACES * int(rng.integers(self.packages))


def make_plain(color: Color) -> np.ndarray:
    """Make a matt material of one colour."""
    row = np.zeros(Material.WIDTH, dtype=np.float32)
    row[Material.COLOR] = row[Material.OTHER_COLOR] = color
    row[Material.TEXTURES] = row[Material.SIZE] = 1.0
    row[Material.BAND_START] = 2.0  # beyond the object: no band
    return row


def make_thing_material(
    rng: np.random.Generator,
    book: TextureBook,
    low: np.ndarray,
    high: np.ndarray,
    hollow: bool = False,
    shiny: float = 0.0,
    printed: float = PRINTED_SHARE,
) -> np.ndarray:
    """Make the material of a thing whose mesh has this box in its own frame [m]."""
    row = make_plain(pick_color(rng))
    if rng.random() < 0.5:
        row[Material.OTHER_COLOR] = np.clip(row[Material.COLOR] * rng.uniform(0.5, 1.5), 0, 1)
    else:
        row[Material.OTHER_COLOR] = pick_color(rng)
    row[Material.TEXTURES], row[Material.SIZE], row[Material.LOW] = book.count, np.maximum(high - low, 1e-4), low
    kind = rng.random()
    if kind < printed:
        row[Material.TEXTURE], row[Material.NEXT_FACE] = book.pick_package(rng), 1.0
        row[Material.BLEND] = TEXTURED if rng.random() < 0.85 else TINTED
        row[Material.MAPPING] = rng.choice([BOXED, WRAPPED])
        row[Material.REPEATS], row[Material.SHIFT] = rng.choice([1, 1, 2]), rng.random()
        row[Material.TURN] = rng.integers(2)
    elif kind < printed + 0.6 * (1 - printed):
        row[Material.BLEND] = PLAIN
    else:
        row[Material.TEXTURE], row[Material.MAPPING] = book.pick_pattern(rng), TILED
        row[Material.SCALE] = rng.uniform(0.2, 1.6) / max(float(np.max(high - low)), 1e-3)
        row[Material.OFFSET] = rng.random(2)
        row[Material.BLEND] = rng.choice([BETWEEN, TINTED, TEXTURED])
        row[Material.TURN] = rng.uniform(0, 6.28)
    _add_second_color(rng, row, hollow)
    _add_gloss(rng, row, shiny)
    return row


def _add_second_color(rng: np.random.Generator, row: np.ndarray, hollow: bool) -> None:
    """Add a cap, a foot, a label's band, or another colour inside."""
    row[Material.BAND_COLOR] = pick_color(rng)
    if hollow and rng.random() < 0.5:
        row[Material.HAS_INSIDE] = 1.0
        if rng.random() < 0.6:
            row[Material.BAND_COLOR] = rng.uniform(0.75, 0.95)
    elif rng.random() < BAND_SHARE:
        row[Material.BAND_AXIS] = 2.0 if rng.random() < 0.7 else rng.integers(2)
        kind = rng.random()
        if kind < 0.5:
            row[Material.BAND] = rng.uniform(0.7, 0.95), 1.1  # a cap
        elif kind < 0.65:
            row[Material.BAND] = -0.1, rng.uniform(0.05, 0.3)
        else:
            row[Material.BAND_START] = rng.uniform(0.1, 0.6)
            row[Material.BAND_END] = row[Material.BAND_START] + rng.uniform(0.1, 0.4)


def _add_gloss(rng: np.random.Generator, row: np.ndarray, shiny: float) -> None:
    kind = rng.random()
    if rng.random() < CLEAR_SHARE:
        row[Material.CLEAR] = rng.uniform(0.6, 0.97)
        row[Material.SPECULAR], row[Material.ROUGHNESS] = 0.05, rng.uniform(0.0, 0.1)
        row[Material.COLOR] = np.clip(0.6 + 0.4 * row[Material.COLOR], 0, 1)
    elif kind < 0.15 + 0.5 * shiny:
        row[Material.SPECULAR], row[Material.ROUGHNESS] = rng.uniform(0.15, 0.7), rng.uniform(0.02, 0.4)
    elif kind < 0.6:
        row[Material.SPECULAR], row[Material.ROUGHNESS] = 0.04, rng.uniform(0.02, 0.5)


def make_surface_material(rng: np.random.Generator, book: TextureBook, table: bool = False) -> np.ndarray:
    """Make the material of a table-top, floor, wall or cloth, tiled in metres."""
    row = make_plain(pick_color(rng))
    row[Material.TEXTURES] = book.count
    if rng.random() < 0.28:
        if rng.random() < 0.7:
            grey = np.clip(rng.uniform(0.05, 0.95) + rng.normal(0, 0.03, 3), 0, 1)
            row[Material.COLOR] = pick_wood_color(rng) if rng.random() < 0.5 else grey
    else:
        row[Material.TEXTURE], row[Material.MAPPING] = book.pick_pattern(rng), TILED
        row[Material.SCALE] = np.exp(rng.uniform(np.log(0.35), np.log(5)))
        row[Material.OFFSET] = rng.random(2)
        row[Material.BLEND] = rng.choice([TEXTURED, TEXTURED, TEXTURED, BETWEEN, TINTED])
        row[Material.TURN] = rng.choice([0, np.pi / 2, rng.uniform(0, 2 * np.pi)])
        row[Material.OTHER_COLOR] = pick_color(rng)
        if row[Material.BLEND] == BETWEEN and rng.random() < 0.7:
            row[Material.COLOR] = pick_wood_color(rng)
            row[Material.OTHER_COLOR] = np.clip(row[Material.COLOR] * rng.uniform(0.6, 1.25), 0, 1)
    if table and rng.random() < 0.55:
        row[Material.SPECULAR], row[Material.ROUGHNESS] = rng.uniform(0.02, 0.08), rng.uniform(0.02, 0.5)
    return row
