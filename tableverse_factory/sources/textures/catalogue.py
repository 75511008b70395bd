"""Procedural table-tops by seed: 1,728 distinct ones, and any number of further ones."""

import difflib
import re
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from schemas.geometry import Picture
from tableverse_factory.core.errors import InputError
from tableverse_factory.sources.textures import cloth, sheets, stone, tiles, wood
from tableverse_factory.sources.textures.draw import TextureSampler
from tableverse_factory.sources.textures.fields import Raster

MEMBERS = 72  # of each family that are tested to be distinct; larger seeds make more of the same families
TILE_M = 0.6  # Length of table that a texture covers before it repeats [m]
MIN_SIZE, MAX_SIZE = 16, 4096

Family = Callable[[TextureSampler], Raster]

# The key of a family's random numbers, and how it is drawn.
_FAMILIES: dict[str, tuple[int, Family]] = {
    "planks": (
        0,
        partial(wood.draw_boards_in_rows, downs=(4, 5, 6, 8, 10), rights=(1, 2), seam=0.0016, tones=0.14, rings=4.5),
    ),
    "marble": (1, stone.draw_marble),
    "linen": (2, cloth.draw_linen),
    "square_tiles": (3, tiles.draw_glazed_tiles),
    "brushed_metal": (4, sheets.draw_brushed_metal),
    "terrazzo": (5, stone.draw_terrazzo),
    "butcher_block": (
        6,
        partial(wood.draw_boards_in_rows, downs=(12, 16, 20, 24), rights=(2, 4), seam=0.0005, tones=0.3, rings=3.0),
    ),
    "gingham": (7, cloth.draw_gingham),
    "concrete": (8, stone.draw_concrete),
    "leather": (9, sheets.draw_leather),
    "laminate": (12, sheets.draw_laminate),
    "tartan": (13, cloth.draw_tartan),
    "granite": (14, stone.draw_granite),
    "veneer": (15, wood.draw_veneer),
    "mosaic": (17, tiles.draw_mosaic),
    "stripes": (18, cloth.draw_stripes),
    "painted_wood": (19, wood.draw_painted_wood),
    "lacquer": (20, sheets.draw_lacquer),
    "travertine": (21, stone.draw_travertine),
    "herringbone_parquet": (22, wood.draw_herringbone_parquet),
    "plywood": (27, wood.draw_plywood),
    "plaster": (30, sheets.draw_plaster),
    "felt": (33, cloth.draw_felt),
    "stone_slabs": (41, tiles.draw_stone_slabs),
}
FAMILIES = tuple(_FAMILIES)  # in the order of the seeds, which go round: 0 is planks, 1 marble, 24 planks again
TEXTURE_COUNT = MEMBERS * len(FAMILIES)  # 1,728

_SUBSTITUTES = {
    "planks": {21: 36, 36: 72, 59: 73, 71: 74},
    "marble": {68: 72},
    "linen": {55: 72, 70: 73},
    "concrete": {15: 37, 20: 36, 36: 72, 37: 73, 67: 74},
    "veneer": {46: 72, 47: 73, 53: 74, 65: 75, 67: 76},
    "lacquer": {18: 36, 36: 72},
    "travertine": {20: 36, 36: 72, 59: 73},
    "herringbone_parquet": {13: 37, 34: 36, 36: 72, 37: 73},
    "plywood": {16: 36, 27: 39, 30: 37, 36: 72, 37: 74, 38: 75, 39: 77, 40: 78, 58: 79, 64: 80, 66: 81},
    "plaster": {28: 37, 32: 36, 36: 72, 37: 73, 68: 74},
    "felt": {13: 36, 36: 72},
    "stone_slabs": {26: 36, 36: 72},
}
"""Members that would look too much like another texture, and the number that is drawn in their place."""


def make_texture(seed: int, size: int = 512) -> Picture:
    """Make the texture of a seed, `size` pixels a side: the same bytes on every machine, and no seam."""
    if not MIN_SIZE <= size <= MAX_SIZE:
        raise InputError(f"a texture of {size} px: give {MIN_SIZE} to {MAX_SIZE}")
    family, number = _split_seed(seed)
    number = _SUBSTITUTES.get(family, {}).get(number, number)
    key, draw_family = _FAMILIES[family]
    rng = np.random.default_rng(np.random.SeedSequence([key, number]))
    raster = draw_family(TextureSampler(rng, number, size, start=0.618034 * key))
    return np.rint(np.clip(raster, 0, 255)).astype(np.uint8)


def name_texture(seed: int) -> str:
    """Name a texture by family and number within it, as `marble-12`."""
    family, number = _split_seed(seed)
    return f"{family}-{number}"


def parse_texture_seed(name: int | str) -> int:
    """Parse the name of a texture, or a seed, into a seed."""
    text = str(name)
    family, _, number = text.rpartition("-")
    strange = "-" in text and family not in FAMILIES
    if strange or not number.isdecimal() or not number.isascii() or len(number) > 16:
        raise InputError(
            f"no texture {text[:60]!r}: give a seed, or family and number as marble-12; {_suggest_family(text)}"
        )
    return int(number) * len(FAMILIES) + FAMILIES.index(family) if family else int(number)


def _suggest_family(text: str) -> str:
    letters = re.sub(r"[^a-z_]+", "_", text[:60].lower()).strip("_")
    within = [family for family in FAMILIES if len(letters) > 2 and letters in family]
    close = within[:4] or difflib.get_close_matches(letters, FAMILIES, n=2)
    return f"did you mean {' or '.join(close)}?" if close else f"families are {', '.join(sorted(FAMILIES))}"


def _split_seed(seed: Any) -> tuple[str, int]:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**63:
        raise InputError(f"texture seed {seed!r:.60}: give a whole number from 0 on")
    number, family = divmod(int(seed), len(FAMILIES))
    return FAMILIES[family], number
