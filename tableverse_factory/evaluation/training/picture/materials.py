"""Materials of things, tables and rooms: rows of the tracer's table, whose columns `tracer.cu` names."""

from dataclasses import dataclass

import numpy as np

from tableverse_factory.evaluation.training.picture.patterns import FACES, Color, pick_color, pick_wood_color
from tableverse_factory.evaluation.training.picture.tables import MATERIAL

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
    row = np.zeros(MATERIAL, dtype=np.float32)
    row[6:9] = row[9:12] = color
    row[16:20] = 1.0
    row[25] = 2.0  # a band beyond the object: none
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
        row[9:12] = np.clip(row[6:9] * rng.uniform(0.5, 1.5), 0, 1)
    else:
        row[9:12] = pick_color(rng)
    row[16], row[17:20], row[20:23] = book.count, np.maximum(high - low, 1e-4), low
    kind = rng.random()
    if kind < printed:
        row[0], row[31] = book.pick_package(rng), 1.0
        row[12] = TEXTURED if rng.random() < 0.85 else TINTED
        row[1] = rng.choice([BOXED, WRAPPED])
        row[2], row[4], row[23] = rng.choice([1, 1, 2]), rng.random(), rng.integers(2)
    elif kind < printed + 0.6 * (1 - printed):
        row[12] = PLAIN
    else:
        row[0], row[1] = book.pick_pattern(rng), TILED
        row[2:4] = rng.uniform(0.2, 1.6) / max(float(np.max(high - low)), 1e-3)
        row[4:6], row[12], row[23] = rng.random(2), rng.choice([BETWEEN, TINTED, TEXTURED]), rng.uniform(0, 6.28)
    _add_second_color(rng, row, hollow)
    _add_gloss(rng, row, shiny)
    return row


def _add_second_color(rng: np.random.Generator, row: np.ndarray, hollow: bool) -> None:
    """Add a cap, a foot, a label's band, or another colour inside."""
    row[27:30] = pick_color(rng)
    if hollow and rng.random() < 0.5:
        row[30] = 1.0
        if rng.random() < 0.6:
            row[27:30] = rng.uniform(0.75, 0.95)
    elif rng.random() < BAND_SHARE:
        row[24] = 2.0 if rng.random() < 0.7 else rng.integers(2)
        kind = rng.random()
        if kind < 0.5:
            row[25:27] = rng.uniform(0.7, 0.95), 1.1  # a cap
        elif kind < 0.65:
            row[25:27] = -0.1, rng.uniform(0.05, 0.3)
        else:
            row[25] = rng.uniform(0.1, 0.6)
            row[26] = row[25] + rng.uniform(0.1, 0.4)


def _add_gloss(rng: np.random.Generator, row: np.ndarray, shiny: float) -> None:
    kind = rng.random()
    if rng.random() < CLEAR_SHARE:
        row[15], row[14], row[13] = rng.uniform(0.6, 0.97), 0.05, rng.uniform(0.0, 0.1)
        row[6:9] = np.clip(0.6 + 0.4 * row[6:9], 0, 1)
    elif kind < 0.15 + 0.5 * shiny:
        row[14], row[13] = rng.uniform(0.15, 0.7), rng.uniform(0.02, 0.4)
    elif kind < 0.6:
        row[14], row[13] = 0.04, rng.uniform(0.02, 0.5)


def make_surface_material(rng: np.random.Generator, book: TextureBook, table: bool = False) -> np.ndarray:
    """Make the material of a table-top, floor, wall or cloth, tiled in metres."""
    row = make_plain(pick_color(rng))
    row[16] = book.count
    if rng.random() < 0.28:
        if rng.random() < 0.7:
            grey = np.clip(rng.uniform(0.05, 0.95) + rng.normal(0, 0.03, 3), 0, 1)
            row[6:9] = pick_wood_color(rng) if rng.random() < 0.5 else grey
    else:
        row[0], row[1] = book.pick_pattern(rng), TILED
        row[2:4] = np.exp(rng.uniform(np.log(0.35), np.log(5)))
        row[4:6], row[12] = rng.random(2), rng.choice([TEXTURED, TEXTURED, TEXTURED, BETWEEN, TINTED])
        row[23] = rng.choice([0, np.pi / 2, rng.uniform(0, 2 * np.pi)])
        row[9:12] = pick_color(rng)
        if row[12] == BETWEEN and rng.random() < 0.7:
            row[6:9] = pick_wood_color(rng)
            row[9:12] = np.clip(row[6:9] * rng.uniform(0.6, 1.25), 0, 1)
    if table and rng.random() < 0.55:
        row[14], row[13] = rng.uniform(0.02, 0.08), rng.uniform(0.02, 0.5)
    return row
