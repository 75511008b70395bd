"""Wood: planks, butcher block, herringbone parquet, veneer, plywood, painted and worn boards."""

from collections.abc import Sequence

import numpy as np

from tableverse_factory.sources.textures.boards import BoardLayout, lay_herringbone, lay_rows
from tableverse_factory.sources.textures.draw import TextureSampler, parse_hex, scale_color
from tableverse_factory.sources.textures.fields import (
    Color,
    Field,
    Raster,
    bell,
    brighten,
    gather_wrapped,
    map_colors,
    paint,
    pixel_grid,
    smoothstep,
    take_fraction,
)

SPECIES: tuple[tuple[str, str], ...] = (
    ("e3c69b", "b98a57"),  # oak
    ("8a5f3e", "4a2e1c"),  # walnut
    ("ecd8b4", "cfa878"),  # maple
    ("c27e4c", "8a4a26"),  # cherry
    ("9a4c32", "5a2417"),  # mahogany
    ("f0d49a", "c68c48"),  # pine
    ("e6dcc6", "b7a27e"),  # ash
    ("b5854a", "76502a"),  # teak
    ("4a3a30", "241a15"),  # wenge
    ("dcc2a4", "ab7f5e"),  # beech
    ("b9b2a6", "857c70"),  # weathered
    ("efe9dd", "c9bfae"),  # limed
    ("6e675f", "47413b"),  # smoked
    ("a8713a", "5f3817"),  # rosewood
    ("cfae86", "8d6a48"),  # elm
)
"""Light and dark of the grain."""


def draw_boards_in_rows(
    draw: TextureSampler, downs: Sequence[int], rights: tuple[int, int], seam: float, tones: float, rings: float
) -> Raster:
    """Draw boards in rows: long planks, or short staves glued into a butcher block.

    A row has `rights` boards, from least to greatest; seams are measured over the side of the square; `rings` grow
    across half the width of a board.
    """
    down, right = draw.choose(downs), draw.whole(*rights)
    return _draw_boards(draw, lay_rows(draw.size, down, right, draw.rng.random(down)), seam, tones, rings)


def draw_herringbone_parquet(draw: TextureSampler) -> Raster:
    """Draw boards that meet at right angles."""
    repeats, length = draw.choose(((1, 4), (2, 3), (1, 5), (2, 4), (1, 6)))
    return _draw_boards(draw, lay_herringbone(draw.size, repeats, length), seam=0.0014, tones=0.2, rings=3.5)


def draw_veneer(draw: TextureSampler) -> Raster:
    """Draw wide leaves of one stem, side by side, as on the top of a good table."""
    down = draw.whole(1, 3)
    leaves = lay_rows(draw.size, down, 1, draw.rng.random(down))
    raster = _draw_boards(draw, leaves, seam=0.0, tones=0.05, rings=26.0 / down)
    return brighten(raster, 0.05 * draw.noise((5, 2), 2))


def draw_plywood(draw: TextureSampler) -> Raster:
    """Draw pale rotary-cut veneer with wide flames, and now and then a patch."""
    light, dark = _draw_species(draw, (2, 5, 6, 9, 0))
    flames = draw.noise((1, 4), 3) * draw.between(1.5, 3.5)
    grain = _make_fibres(draw)
    rings = take_fraction(flames + 0.03 * grain)
    weight = 0.2 + 0.45 * smoothstep(rings, 0.1, 0.95) * smoothstep(rings, 1.0, 0.93) + 0.09 * grain
    raster = brighten(map_colors(weight, (light, dark)), 0.04 * draw.noise((2, 3), 2))
    for _ in range(draw.whole(0, 3)):
        raster = _draw_patch(draw, raster, draw.near(light, 14))
    return raster


def draw_painted_wood(draw: TextureSampler) -> Raster:
    """Draw boards under paint, rubbed through to the wood here and there."""
    down = draw.choose((4, 5, 6, 8))
    boards = lay_rows(draw.size, down, 1, draw.rng.random(down))
    wood = _draw_boards(draw, boards, seam=0.0018, tones=0.15, rings=4.5)
    coat = draw.color((0.35, 0.58), (0.0, 0.13))
    strokes = _make_fibres(draw)
    wear = draw.noise((2, 5), 5, 0.6) + 0.5 * strokes + 1.2 * bell(boards.edge, 0.006)
    cover = smoothstep(wear, draw.between(1.7, 2.6), draw.between(1.0, 1.5))
    tone = draw.each(boards.count, 0.07)[boards.ids]
    coated = paint(wood, coat, 0.96 * cover)
    return brighten(coated, 0.035 * strokes * cover + tone - 0.45 * bell(boards.edge, 0.0014))


def _draw_species(draw: TextureSampler, among: tuple[int, ...] = tuple(range(len(SPECIES)))) -> tuple[Color, Color]:
    light, dark = SPECIES[among[int(len(among) * draw.spread(0))]]
    tint, depth = 0.8 + 0.24 * draw.spread(1), 0.3 + 0.7 * draw.spread(3)
    pale = scale_color(parse_hex(light), tint)
    return draw.near(pale, 12), draw.near(np.rint(pale + depth * (parse_hex(dark) * tint - pale)), 10)


def _make_fibres(draw: TextureSampler) -> Field:
    return draw.noise((6, 110), 2, 0.8)


def _draw_boards(draw: TextureSampler, boards: BoardLayout, seam: float, tones: float, rings: float) -> Raster:
    """Draw boards of one species, each from another place of the stem, with `rings` across their half width."""
    light, dark = _draw_species(draw)
    tone = draw.each(boards.count, tones)[boards.ids]
    late, fibres = _make_grain(draw, boards, rings * draw.between(0.7, 1.3))
    weight = 0.3 + tone + draw.between(0.1, 0.3) * late + draw.between(0.06, 0.13) * fibres
    raster = map_colors(weight, (scale_color(light, 1.03), light, dark, scale_color(dark, 0.75)))
    return brighten(raster, -0.55 * bell(boards.edge, seam)) if seam else raster


def _make_grain(draw: TextureSampler, boards: BoardLayout, frequency: float) -> tuple[Field, Field]:
    """Make late wood of rings, 0–1, and fibres: a plain-sawn board cuts its stem's rings at √(y² + h(x)²)."""
    bend, fine = draw.noise((2, 3), 3), _make_fibres(draw)
    pores = smoothstep(draw.noise((24, 200), 1), 1.0, 2.0)
    index = np.arange(draw.size, dtype=np.int32)
    offset = draw.rng.integers(0, draw.size, (2, boards.count), dtype=np.int32)
    # The fields' grain runs to the right; each board looks into another place of them.
    right = np.where(boards.upright, index[:, None], index[None, :]) + offset[0][boards.ids]
    down = np.where(boards.upright, index[None, :], index[:, None]) + offset[1][boards.ids]
    bend, fine, pores = (gather_wrapped(field, right, down) for field in (bend, fine, pores))
    middle = draw.each(boards.count, 1.3)[boards.ids] + 0.12 * bend
    y = 2 * boards.across - 1 - middle
    h = draw.rng.random(boards.count, dtype=np.float32)[boards.ids] + 0.45 * bend
    distance = np.sqrt(y * y + h * h)
    turns = take_fraction(distance * np.float32(frequency) + 0.06 * fine)
    rings = smoothstep(turns, 0.0, 0.9) * smoothstep(turns, 1.0, 0.92)
    return rings, fine + 1.6 * pores


def _draw_patch(draw: TextureSampler, raster: Raster, color: Color) -> Raster:
    u, v = pixel_grid(len(raster))
    x, y = (take_fraction(t - np.float32(draw.between(0, 1))) - 0.5 for t in (u, v))
    distance = np.sqrt((x / 0.055) ** 2 + (y / 0.022) ** 2)
    inside, rim = smoothstep(distance, 1.02, 0.98), bell(distance - 1, 0.06)
    return brighten(paint(raster, color, 0.75 * inside), -0.3 * rim)
