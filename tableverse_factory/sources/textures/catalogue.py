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

TEXTURE_COUNT = 1728  # Textures that are tested to be distinct; seeds beyond make more of the same families
TILE_M = 0.6  # Length of table that a texture covers before it repeats [m]
MIN_SIZE, MAX_SIZE = 16, 4096

Family = Callable[[TextureSampler], Raster]

FAMILIES: dict[str, Family] = {
    "planks": partial(
        wood.draw_boards_in_rows, downs=(4, 5, 6, 8, 10), rights=(1, 2), seam=0.0016, tones=0.14, rings=4.5
    ),
    "marble": stone.draw_marble,
    "linen": cloth.draw_linen,
    "square_tiles": partial(tiles.draw_glazed_tiles, layouts=((4, 4), (6, 6), (8, 8), (10, 10), (12, 12))),
    "brushed_metal": sheets.draw_brushed_metal,
    "terrazzo": stone.draw_terrazzo,
    "butcher_block": partial(
        wood.draw_boards_in_rows, downs=(12, 16, 20, 24), rights=(2, 4), seam=0.0005, tones=0.3, rings=3.0
    ),
    "gingham": cloth.draw_gingham,
    "concrete": stone.draw_concrete,
    "leather": sheets.draw_leather,
    "parquet": wood.draw_parquet,
    "hexagons": tiles.draw_hexagons,
    "laminate": sheets.draw_laminate,
    "tartan": cloth.draw_tartan,
    "granite": stone.draw_granite,
    "veneer": wood.draw_veneer,
    "cork": sheets.draw_cork,
    "mosaic": tiles.draw_mosaic,
    "stripes": cloth.draw_stripes,
    "painted_wood": wood.draw_painted_wood,
    "lacquer": sheets.draw_lacquer,
    "travertine": stone.draw_travertine,
    "herringbone_parquet": wood.draw_herringbone_parquet,
    "twill": cloth.draw_twill,
    "checkers": tiles.draw_checkers,
    "hammered_metal": sheets.draw_hammered_metal,
    "onyx": stone.draw_onyx,
    "plywood": wood.draw_plywood,
    "houndstooth": cloth.draw_houndstooth,
    "bricks": partial(
        tiles.draw_glazed_tiles, layouts=((8, 4), (12, 4), (12, 6), (16, 8), (20, 6)), steps=(0.5, 1 / 3)
    ),
    "plaster": sheets.draw_plaster,
    "strand_board": wood.draw_strand_board,
    "slate": stone.draw_slate,
    "felt": cloth.draw_felt,
    "cement_tiles": tiles.draw_cement_tiles,
    "galvanised": sheets.draw_galvanised,
    "bamboo": wood.draw_bamboo,
    "windowpane": cloth.draw_windowpane,
    "sandstone": stone.draw_sandstone,
    "rubber": sheets.draw_rubber,
    "dots": cloth.draw_dots,
    "stone_slabs": tiles.draw_stone_slabs,
    "patina": sheets.draw_patina,
    "tweed": cloth.draw_tweed,
    "chipboard": sheets.draw_chipboard,
    "wicker": cloth.draw_wicker,
    "broken_mosaic": tiles.draw_broken_mosaic,
    "tread_plate": sheets.draw_tread_plate,
}
"""In the order of the seeds, which go round: seed 0 is planks, seed 1 marble, seed 48 planks again."""


_SUBSTITUTES = {
    36: (657, 795, 806, 884, 968, 981, 1008, 1187, 1264, 1289, 1417, 1566, 1567, 1616, 1654, 1668),
    37: (646, 728, 752, 947, 1374, 1467, 1504),
    39: (755, 1323),
    40: (1043,),
}  # fmt: skip
"""Members that replace those which look too much like another texture: number in the family, and seeds replaced."""

_NUMBERS = {seed: number for number, seeds in _SUBSTITUTES.items() for seed in seeds}


def make_texture(seed: int, size: int = 512) -> Picture:
    """Make the texture of a seed, `size` pixels a side: the same bytes on every machine, and no seam."""
    if not MIN_SIZE <= size <= MAX_SIZE:
        raise InputError(f"a texture of {size} px: give {MIN_SIZE} to {MAX_SIZE}")
    family, number = _split_seed(seed)
    index, number = int(seed) % len(FAMILIES), _NUMBERS.get(int(seed), number)
    rng = np.random.default_rng(np.random.SeedSequence([index, number]))
    draw = TextureSampler(rng, number, size, start=0.618034 * index)
    return np.rint(np.clip(FAMILIES[family](draw), 0, 255)).astype(np.uint8)


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
    return int(number) * len(FAMILIES) + list(FAMILIES).index(family) if family else int(number)


def _suggest_family(text: str) -> str:
    letters = re.sub(r"[^a-z_]+", "_", text[:60].lower()).strip("_")
    within = [family for family in FAMILIES if len(letters) > 2 and letters in family]
    close = within[:4] or difflib.get_close_matches(letters, FAMILIES, n=2)
    return f"did you mean {' or '.join(close)}?" if close else f"families are {', '.join(sorted(FAMILIES))}"


def _split_seed(seed: Any) -> tuple[str, int]:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**63:
        raise InputError(f"texture seed {seed!r:.60}: give a whole number from 0 on")
    number, family = divmod(int(seed), len(FAMILIES))
    return list(FAMILIES)[family], number
