"""Wood: boards, parquet, butcher block, bamboo, veneer, plywood, painted and worn, strand board."""

import numpy as np

from tableverse_factory.sources.textures.boards import Boards, baskets, herringbone, rows
from tableverse_factory.sources.textures.draw import Draw, oklch, rgb, shaded
from tableverse_factory.sources.textures.fields import (
    Color,
    Field,
    Raster,
    bell,
    cells,
    chosen,
    fraction,
    lit,
    moved,
    noise,
    painted,
    ramp,
    smooth,
    square,
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


def planks(draw: Draw, size: int) -> Raster:
    """Long boards side by side, with rings, fibres and pores."""
    down = (4, 5, 6, 8, 10)[int(5 * draw.spread(2))]
    right = draw.whole(1, 2)
    return _boarded(draw, size, rows(size, down, right, draw.rng.random(down)), seam=0.0016, tones=0.14, rings=4.5)


def butcher_block(draw: Draw, size: int) -> Raster:
    """Short staves glued into a thick plate: each has a tone of its own, no seam shows."""
    down = (12, 16, 20, 24)[int(4 * draw.spread(2))]
    right = draw.whole(2, 4)
    return _boarded(draw, size, rows(size, down, right, draw.rng.random(down)), seam=0.0005, tones=0.3, rings=3.0)


def parquet(draw: Draw, size: int) -> Raster:
    """Squares of strips, every other one turned."""
    blocks, strips = (4, 6, 8)[int(3 * draw.spread(2))], draw.whole(3, 6)
    return _boarded(draw, size, baskets(size, blocks, strips), seam=0.0012, tones=0.24, rings=3.0)


def herringbone_parquet(draw: Draw, size: int) -> Raster:
    """Boards that meet at right angles."""
    repeats, length = ((1, 4), (2, 3), (1, 5), (2, 4), (1, 6))[int(5 * draw.spread(2))]
    return _boarded(draw, size, herringbone(size, repeats, length), seam=0.0014, tones=0.2, rings=3.5)


def veneer(draw: Draw, size: int) -> Raster:
    """Wide leaves of one stem, side by side, as on the top of a good table."""
    down = draw.whole(1, 3)
    raster = _boarded(draw, size, rows(size, down, 1, draw.rng.random(down)), seam=0.0, tones=0.05, rings=26.0 / down)
    return lit(raster, 0.05 * noise(draw.rng, size, (5, 2), 2))


def plywood(draw: Draw, size: int) -> Raster:
    """Pale rotary-cut veneer with wide flames, and now and then a patch."""
    light, dark = _species(draw, (2, 5, 6, 9, 0))
    flames = noise(draw.rng, size, (1, 4), 3) * draw.between(1.5, 3.5)
    grain = _fibres(draw, size)
    rings = fraction(flames + 0.03 * grain)
    weight = 0.2 + 0.45 * smooth(rings, 0.1, 0.95) * smooth(rings, 1.0, 0.93) + 0.09 * grain
    raster = lit(ramp(weight, (light, dark)), 0.04 * noise(draw.rng, size, (2, 3), 2))
    for _ in range(draw.whole(0, 3)):
        raster = _patched(draw, raster, draw.near(light, 14))
    return raster


def bamboo(draw: Draw, size: int) -> Raster:
    """Narrow slats with their knots."""
    down, right = (24, 32, 40)[int(3 * draw.spread(2))], draw.whole(2, 3)
    boards = rows(size, down, right, draw.rng.random(down))
    light = oklch(0.62 + 0.26 * draw.spread(1), 0.06 + 0.05 * draw.spread(3), 0.17 + 0.07 * draw.spread(0))
    tone = chosen(boards.ids, _each(draw, boards.count, 0.18))
    grain = noise(draw.rng, size, (3, 160), 2)
    knot = bell(boards.along - 0.5, 0.02 * right / 2)
    weight = 0.35 + tone + 0.12 * grain + 0.45 * knot
    raster = ramp(weight, (shaded(light, 1.12), light, shaded(light, 0.62)))
    return lit(raster, -0.35 * bell(boards.edge, 0.0009))


def painted_wood(draw: Draw, size: int) -> Raster:
    """Boards under paint, rubbed through to the wood here and there."""
    down = (4, 5, 6, 8)[int(4 * draw.spread(2))]
    boards = rows(size, down, 1, draw.rng.random(down))
    wood = _boarded(draw, size, boards, seam=0.0018, tones=0.15, rings=4.5)
    paint = oklch(0.35 + 0.58 * draw.spread(1), 0.13 * draw.spread(3), draw.spread(0))
    strokes = _fibres(draw, size)
    wear = noise(draw.rng, size, (2, 5), 5, 0.6) + 0.5 * strokes + 1.2 * bell(boards.edge, 0.006)
    cover = smooth(wear, draw.between(1.7, 2.6), draw.between(1.0, 1.5))
    tone = chosen(boards.ids, _each(draw, boards.count, 0.07))
    coated = painted(wood, paint, 0.96 * cover)
    return lit(coated, 0.035 * strokes * cover + tone - 0.45 * bell(boards.edge, 0.0014))


def strand_board(draw: Draw, size: int) -> Raster:
    """Flat flakes of wood pressed together (OSB): layers of long cells at several angles, the nearest one shows."""
    light, dark = _species(draw, (0, 5, 9, 3, 14, 7))
    fine = (10, 14, 18)[int(3 * draw.spread(2))]
    top, weight = np.full((size, size), 9.0, dtype=np.float32), np.zeros((size, size), dtype=np.float32)
    grain = noise(draw.rng, size, (12, 120), 2)
    index = np.arange(size, dtype=np.int32)
    for slope in (0, 1, -1, 2):
        flakes = cells(draw.rng, size, (fine // 2, fine * 2))
        height = draw.rng.random(flakes.count, dtype=np.float32)
        tone = draw.rng.random(flakes.count, dtype=np.float32)
        layer = height[flakes.ids] + 1.4 * flakes.nearest
        value = tone[flakes.ids] + 0.13 * grain + 0.9 * smooth(flakes.border, 0.12, 0.0)
        # A shear keeps the square periodic; a transposition turns the flakes upright.
        layer, value = (
            moved(f, index[None, :], index[:, None] + (slope % 2) * slope * index[None, :]) for f in (layer, value)
        )
        if slope == 2:
            layer, value = layer.T, value.T
        nearer = layer < top
        top, weight = np.where(nearer, layer, top), np.where(nearer, value, weight)
    return ramp(0.1 + 0.6 * weight, (shaded(light, 1.05), light, dark, shaded(dark, 0.6)))


def _species(draw: Draw, among: tuple[int, ...] = tuple(range(len(SPECIES)))) -> tuple[Color, Color]:
    light, dark = SPECIES[among[int(len(among) * draw.spread(0))]]
    tint, depth = 0.8 + 0.24 * draw.spread(1), 0.3 + 0.7 * draw.spread(3)
    pale = shaded(rgb(light), tint)
    return draw.near(pale, 12), draw.near(np.rint(pale + depth * (rgb(dark) * tint - pale)), 10)


def _each(draw: Draw, count: int, far: float) -> np.ndarray:
    """A number between -far and far for each board."""
    values: np.ndarray = (draw.rng.random(count, dtype=np.float32) * 2 - 1) * np.float32(far)
    return values


def _fibres(draw: Draw, size: int) -> Field:
    """Fine streaks to the right."""
    return noise(draw.rng, size, (6, 110), 2, 0.8)


def _boarded(draw: Draw, size: int, boards: Boards, seam: float, tones: float, rings: float) -> Raster:
    """Boards of one species, each from another place of the stem, with about so many rings across their half width."""
    light, dark = _species(draw)
    tone = chosen(boards.ids, _each(draw, boards.count, tones))
    late, fibres = _grain(draw, size, boards, rings * draw.between(0.7, 1.3))
    weight = 0.3 + tone + draw.between(0.1, 0.3) * late + draw.between(0.06, 0.13) * fibres
    raster = ramp(weight, (shaded(light, 1.03), light, dark, shaded(dark, 0.75)))
    return lit(raster, -0.55 * bell(boards.edge, seam)) if seam else raster


def _grain(draw: Draw, size: int, boards: Boards, frequency: float) -> tuple[Field, Field]:
    """Late wood of the rings, 0–1, and fibres with pores: a plain-sawn board cuts its stem's rings at √(y² + h(x)²)."""
    bend, fine = noise(draw.rng, size, (2, 3), 3), _fibres(draw, size)
    pores = smooth(noise(draw.rng, size, (24, 200), 1), 1.0, 2.0)
    right, down = _own_places(draw, size, boards)
    bend, fine, pores = (moved(field, right, down) for field in (bend, fine, pores))
    middle = chosen(boards.ids, _each(draw, boards.count, 1.3)) + 0.12 * bend
    y = 2 * boards.across - 1 - middle
    h = chosen(boards.ids, draw.rng.random(boards.count, dtype=np.float32)) + 0.45 * bend
    distance = np.sqrt(y * y + h * h)
    turns = fraction(distance * np.float32(frequency) + 0.06 * fine)
    rings = smooth(turns, 0.0, 0.9) * smooth(turns, 1.0, 0.92)
    return rings, fine + 1.6 * pores


def _own_places(draw: Draw, size: int, boards: Boards) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel looks into fields whose grain runs to the right: another place for each board."""
    index = np.arange(size, dtype=np.int32)
    offset = draw.rng.integers(0, size, (2, boards.count), dtype=np.int32)
    right = np.where(boards.upright, index[:, None], index[None, :]) + offset[0][boards.ids]
    down = np.where(boards.upright, index[None, :], index[:, None]) + offset[1][boards.ids]
    return right, down


def _patched(draw: Draw, raster: Raster, color: Color) -> Raster:
    """An oval patch, its grain the same way."""
    u, v = square(len(raster))
    x, y = (fraction(t - np.float32(draw.between(0, 1))) - 0.5 for t in (u, v))
    distance = np.sqrt((x / 0.055) ** 2 + (y / 0.022) ** 2)
    inside, rim = smooth(distance, 1.02, 0.98), bell(distance - 1, 0.06)
    return lit(painted(raster, color, 0.75 * inside), -0.3 * rim)
