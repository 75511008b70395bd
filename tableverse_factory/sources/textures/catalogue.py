"""Table-tops from a seed: 1,728 that nobody takes for one another, and as many more as one likes."""

import difflib
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from schemas.geometry import Picture
from tableverse_factory.core.errors import InputError
from tableverse_factory.sources.textures import cloth, sheets, stone, tiles, wood
from tableverse_factory.sources.textures.draw import TextureSampler
from tableverse_factory.sources.textures.fields import Raster

TEXTURE_COUNT = 1728
"""Textures that are held to be distinct (`perception.MIN_DISTANCE`); seeds beyond make more of the same families."""

TILE_M = 0.6
"""Length of table that a texture is meant to cover before it repeats [m]."""

MIN_SIZE, MAX_SIZE = 16, 4096

Family = Callable[[TextureSampler], Raster]

FAMILIES: dict[str, Family] = {
    "planks": wood.planks,
    "marble": stone.marble,
    "linen": cloth.linen,
    "square_tiles": tiles.square_tiles,
    "brushed_metal": sheets.brushed_metal,
    "terrazzo": stone.terrazzo,
    "butcher_block": wood.butcher_block,
    "gingham": cloth.gingham,
    "concrete": stone.concrete,
    "leather": sheets.leather,
    "parquet": wood.parquet,
    "hexagons": tiles.hexagons,
    "laminate": sheets.laminate,
    "tartan": cloth.tartan,
    "granite": stone.granite,
    "veneer": wood.veneer,
    "cork": sheets.cork,
    "mosaic": tiles.mosaic,
    "stripes": cloth.stripes,
    "painted_wood": wood.painted_wood,
    "lacquer": sheets.lacquer,
    "travertine": stone.travertine,
    "herringbone_parquet": wood.herringbone_parquet,
    "twill": cloth.twill,
    "checkers": tiles.checkers,
    "hammered_metal": sheets.hammered_metal,
    "onyx": stone.onyx,
    "plywood": wood.plywood,
    "houndstooth": cloth.houndstooth,
    "bricks": tiles.bricks,
    "plaster": sheets.plaster,
    "strand_board": wood.strand_board,
    "slate": stone.slate,
    "felt": cloth.felt,
    "cement_tiles": tiles.cement_tiles,
    "galvanised": sheets.galvanised,
    "bamboo": wood.bamboo,
    "windowpane": cloth.windowpane,
    "sandstone": stone.sandstone,
    "rubber": sheets.rubber,
    "dots": cloth.dots,
    "stone_slabs": tiles.stone_slabs,
    "patina": sheets.patina,
    "tweed": cloth.tweed,
    "chipboard": sheets.chipboard,
    "wicker": cloth.wicker,
    "broken_mosaic": tiles.broken_mosaic,
    "tread_plate": sheets.tread_plate,
}
"""In the order of the seeds: seed 0 is planks, seed 1 marble, and so on round and round."""


_SUBSTITUTES: dict[int, int] = {
    646: 37,
    657: 36,
    728: 37,
    752: 37,
    755: 39,
    795: 36,
    806: 36,
    884: 36,
    947: 37,
    968: 36,
    981: 36,
    1008: 36,
    1043: 40,
    1187: 36,
    1264: 36,
    1289: 36,
    1323: 39,
    1374: 37,
    1417: 36,
    1467: 37,
    1504: 37,
    1566: 36,
    1567: 36,
    1616: 36,
    1654: 36,
    1668: 36,
}
"""Seeds whose own member of the family looks too much like another's, and the member that they get instead."""


def make_texture(seed: int, size: int = 512) -> Picture:
    """The texture of this seed: the same bytes on every machine, and no seam where it repeats.

    Args:
        seed: From 0 on.
        size: Pixels of a side.

    Raises:
        InputError: if seed or size is out of range.
    """
    if not MIN_SIZE <= size <= MAX_SIZE:
        raise InputError(f"a texture of {size} px: give {MIN_SIZE} to {MAX_SIZE}")
    family, number = _split_seed(seed)
    seed = int(seed)
    number = _SUBSTITUTES.get(seed, number)
    draw = TextureSampler(
        np.random.default_rng(np.random.SeedSequence([seed % len(FAMILIES), number])),
        number,
        size,
        start=0.618034 * (seed % len(FAMILIES)),
    )
    picture: Picture = np.rint(np.clip(FAMILIES[family](draw), 0, 255)).astype(np.uint8)
    return picture


def name_texture(seed: int) -> str:
    """Family and number within it, as `marble-12`.

    Raises:
        InputError: if the seed is out of range.
    """
    family, number = _split_seed(seed)
    return f"{family}-{number}"


def parse_texture_seed(name: int | str) -> int:
    """The seed that a name or a number stands for.

    Raises:
        InputError: if it stands for none.
    """
    text = str(name)
    family, _, number = text.rpartition("-")
    strange = "-" in text and family not in FAMILIES
    if strange or not number.isdecimal() or not number.isascii() or len(number) > 16:
        raise InputError(
            f"no texture {text[:60]!r}: give a seed, or family and number as marble-12; {_suggest_family(text)}"
        )
    return int(number) * len(FAMILIES) + list(FAMILIES).index(family) if family else int(number)


def _suggest_family(text: str) -> str:
    """The families that hold the letters of a name, or look like them; or all."""
    letters = re.sub(r"[^a-z_]+", "_", text[:60].lower()).strip("_")
    within = [family for family in FAMILIES if len(letters) > 2 and letters in family]
    close = within[:4] or difflib.get_close_matches(letters, FAMILIES, n=2)
    return f"did you mean {' or '.join(close)}?" if close else f"families are {', '.join(sorted(FAMILIES))}"


def _split_seed(seed: Any) -> tuple[str, int]:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**63:
        raise InputError(f"texture seed {seed!r:.60}: give a whole number from 0 on")
    number, family = divmod(int(seed), len(FAMILIES))
    return list(FAMILIES)[family], number
