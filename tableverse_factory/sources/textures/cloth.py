"""Cloth: linen, gingham, tartan, stripes, twill, houndstooth, dots, felt, wicker."""

import numpy as np

from tableverse_factory.sources.textures.draw import Draw, oklch, shaded
from tableverse_factory.sources.textures.fields import (
    Color,
    Field,
    Raster,
    chosen,
    fraction,
    lit,
    middles,
    noise,
    painted,
    ramp,
    relief,
    smooth,
    square,
    wave,
)

THREADS = (96, 128, 160)
"""How many threads cross the square."""


def linen(draw: Draw, size: int) -> Raster:
    """Plain weave of uneven threads."""
    base = oklch(0.3 + 0.63 * draw.spread(1), 0.14 * draw.spread(3) ** 2, draw.spread(0))
    threads = THREADS[int(3 * draw.spread(2))]
    slubs = noise(draw.rng, size, (5, threads), 1) + noise(draw.rng, size, (threads, 5), 1)
    raster = ramp(0.5 + draw.between(0.08, 0.2) * slubs, (shaded(base, 0.74), base, shaded(base, 1.16)))
    return lit(raster, 0.09 * _plain_weave(size, threads) + _folds(draw, size))


def gingham(draw: Draw, size: int) -> Raster:
    """Checks of equal stripes."""
    color, ground = _bold(draw), oklch(draw.between(0.9, 0.98), draw.between(0, 0.03), draw.between(0, 1))
    checks = (6, 8, 12, 16, 24)[int(5 * draw.spread(2))]
    u, v = square(size)
    stripes = (smooth(wave(t * checks), -0.03, 0.03) for t in (u, v))
    across, down = stripes
    raster = painted(np.broadcast_to(ground, (size, size, 3)), color, 0.48 * (across + down))
    return _woven(draw, raster)


def windowpane(draw: Draw, size: int) -> Raster:
    """Thin lines of one or two colours on a ground."""
    ground = oklch(0.25 + 0.68 * draw.spread(1), 0.12 * draw.spread(3), draw.spread(0))
    line, second = _bold(draw, 0.5), _contrast(draw, ground)
    count = (4, 6, 8, 10)[int(4 * draw.spread(2))]
    u, v = square(size)
    raster = np.broadcast_to(ground, (size, size, 3))
    for t in (u, v):
        raster = painted(raster, line, 0.8 * _line(t * count, 0.09))
        raster = painted(raster, second, 0.7 * _line(t * count + np.float32(0.5), 0.04))
    return _woven(draw, raster)


def tartan(draw: Draw, size: int) -> Raster:
    """A symmetric sett of stripes, the same both ways, in twill."""
    hue = draw.spread(0)
    colors = [
        oklch(0.3 + 0.35 * draw.spread(1), 0.05 + 0.14 * draw.spread(3), hue),
        oklch(draw.between(0.15, 0.4), draw.between(0.0, 0.12), hue + draw.between(0.2, 0.8)),
        oklch(draw.between(0.5, 0.9), draw.between(0.05, 0.18), hue + draw.between(0.2, 0.8)),
        oklch(draw.between(0.85, 0.97), draw.between(0.0, 0.05), draw.between(0, 1)),
    ]
    half = [draw.whole(0, 3) if k else 0 for k in range(draw.whole(5, 8))]
    widths = [draw.whole(1, 3) if color == 3 else draw.whole(2, 9) for color in half]
    sett = np.repeat([*half, *half[::-1]], [*widths, *widths[::-1]])
    repeats = (2, 3, 4)[int(3 * draw.spread(2))]
    place = (middles(size) * repeats % 1 * len(sett)).astype(np.intp)
    stripe = np.asarray(colors, dtype=np.float32)[sett[place]]
    u, v = square(size)
    warp_on_top = (0.5 + 0.5 * wave((u + v) * 128))[..., None]
    share = 0.5 + 0.16 * (warp_on_top - 0.5) * 2
    raster: Raster = share * stripe[None, :] + (1 - share) * stripe[:, None]
    return lit(raster, 0.04 * noise(draw.rng, size, (90, 90), 2) + _folds(draw, size))


def stripes(draw: Draw, size: int) -> Raster:
    """Ticking: stripes of several widths along one side."""
    ground = oklch(0.55 + 0.42 * draw.spread(1), 0.06 * draw.spread(3), draw.spread(0))
    colors = [_bold(draw), _contrast(draw, ground), shaded(ground, 0.8)]
    repeats = (3, 4, 6, 8)[int(4 * draw.spread(2))]
    u, _ = square(size)
    t = fraction(u * repeats)
    raster = np.broadcast_to(ground, (size, size, 3))
    for color in colors[: draw.whole(2, 3)]:
        middle, half = np.float32(draw.between(0.1, 0.9)), draw.between(0.02, 0.16)
        distance = np.abs(fraction(t - middle + np.float32(0.5)) - np.float32(0.5))
        raster = painted(raster, color, smooth(distance, half + 0.01, half))
    return _woven(draw, raster if draw.chance(0.5) else raster.transpose(1, 0, 2))


def twill(draw: Draw, size: int) -> Raster:
    """Denim and its kin: diagonal ribs, pale threads showing through, worn places."""
    base = oklch(0.25 + 0.5 * draw.spread(1), 0.02 + 0.1 * draw.spread(3), draw.spread(0))
    pale = oklch(draw.between(0.75, 0.92), 0.02, draw.between(0, 1))
    threads = THREADS[int(3 * draw.spread(2))]
    u, v = square(size)
    ribs = wave((u + v) * (threads // 2)) + 0.5 * wave((u - 2 * v) * threads)
    yarn = noise(draw.rng, size, (threads, 4), 1) + 0.6 * noise(draw.rng, size, (threads, 40), 1)
    worn = noise(draw.rng, size, (2, 2), 3)
    weight = 0.24 + 0.13 * ribs + 0.1 * yarn + draw.between(0.03, 0.12) * worn
    return ramp(weight, (shaded(base, 0.8), base, pale))


def houndstooth(draw: Draw, size: int) -> Raster:
    """Four dark and four light threads, both ways, in a two-over-two twill: the broken check comes by itself."""
    light = oklch(0.72 + 0.26 * draw.spread(1), 0.1 * draw.spread(3), draw.spread(0) + 0.5)
    dark = oklch(0.15 + 0.35 * draw.spread(4), 0.13 * draw.spread(3), draw.spread(0))
    repeats = (6, 8, 12, 16)[int(4 * draw.spread(2))]
    u, v = square(size)
    i, j = (np.floor(t * (8 * repeats)).astype(np.int32) for t in (u, v))
    warp_on_top = (i - j) % 4 < 2
    dark_here = np.where(warp_on_top, i % 8 < 4, j % 8 < 4)
    blurred = dark_here.astype(np.float32)
    return _woven(draw, ramp(blurred, (light, dark)))


def dots(draw: Draw, size: int) -> Raster:
    """Polka dots in a staggered grid."""
    ground = oklch(0.25 + 0.7 * draw.spread(1), 0.15 * draw.spread(3), draw.spread(0))
    color = _contrast(draw, ground)
    count = (6, 8, 12, 18)[int(4 * draw.spread(2))]
    u, v = square(size)
    radius = draw.between(0.18, 0.36)
    distance = np.minimum(*(_from_middle(u * count + shift, v * count + shift) for shift in (0.0, 0.5)))
    raster = painted(np.broadcast_to(ground, (size, size, 3)), color, smooth(distance, radius + 0.03, radius - 0.03))
    return _woven(draw, raster)


def felt(draw: Draw, size: int) -> Raster:
    """Matted fibres of two tones."""
    base = oklch(0.22 + 0.66 * draw.spread(1), 0.15 * draw.spread(3), draw.spread(0))
    fibres = noise(draw.rng, size, (40, 120), 2) + noise(draw.rng, size, (120, 40), 2)
    melange = draw.between(0.06, 0.3)
    weight = 0.5 + melange * 0.5 * fibres + 0.06 * noise(draw.rng, size, (6, 6), 3)
    raster = ramp(weight, (shaded(base, 0.7), base, oklch(min(0.97, 0.4 + 0.66 * draw.spread(1)), 0.02, 0.0)))
    return lit(raster, relief(fibres, 0.05))


def tweed(draw: Draw, size: int) -> Raster:
    """Herringbone of two yarns with coloured flecks."""
    dark = oklch(0.2 + 0.35 * draw.spread(1), 0.07 * draw.spread(3), draw.spread(0))
    light = oklch(0.55 + 0.35 * draw.spread(4), 0.05 * draw.spread(3), draw.spread(0) + 0.08)
    columns = (8, 12, 16, 24)[int(4 * draw.spread(2))]
    u, v = square(size)
    zigzag = np.abs(fraction(u * (columns // 2)) - np.float32(0.5)) * np.float32(8 * 24 / columns)
    ribs = wave(v * 64 + zigzag)
    yarn = noise(draw.rng, size, (100, 100), 2, 0.9)
    raster = ramp(0.5 + 0.36 * ribs + 0.14 * yarn, (dark, light))
    flecks = smooth(noise(draw.rng, size, (60, 40), 2), 2.0, 2.6)
    return painted(raster, oklch(0.65, 0.14, draw.between(0, 1)), flecks)


def wicker(draw: Draw, size: int) -> Raster:
    """Strands over and under pairs of stakes."""
    base = oklch(0.35 + 0.5 * draw.spread(1), 0.02 + 0.07 * draw.spread(3), 0.08 + 0.16 * draw.spread(0))
    down, right = (20, 28, 36)[int(3 * draw.spread(2))], (8, 12, 16)[int(3 * draw.spread(4))]
    u, v = square(size)
    row = np.floor(v * down).astype(np.int32)
    inside = fraction(v * down) * 2 - 1
    over = wave(u * (right // 2) + 0.5 * (row % 2).astype(np.float32))
    round_strand = np.sqrt(np.maximum(1 - inside * inside, 0))
    shade = 0.35 * (round_strand - 0.7) + 0.3 * (over - 0.2) * round_strand
    tone = chosen(row, ((draw.rng.random(down, dtype=np.float32) - np.float32(0.5)) * np.float32(0.16)))
    grain = noise(draw.rng, size, (12, 4 * down), 2)
    gap = smooth(over, -0.55, -0.9) * 0.35
    raster = ramp(0.5 + 0.1 * grain + tone, (shaded(base, 0.75), base, shaded(base, 1.15)))
    return lit(raster, np.clip(shade - gap - 0.3 * smooth(round_strand, 0.4, 0.0), -0.85, 0.5))


def _bold(draw: Draw, bright: float = 0.3) -> Color:
    return oklch(bright + 0.35 * draw.spread(4), 0.06 + 0.14 * draw.between(0, 1), draw.spread(0))


def _contrast(draw: Draw, ground: Color) -> Color:
    bright = draw.between(0.2, 0.45) if float(ground.sum()) > 3 * 128 else draw.between(0.75, 0.97)
    return oklch(bright, draw.between(0.02, 0.16), draw.between(0, 1))


def _plain_weave(size: int, threads: int) -> Field:
    """Over and under: one thread shows, then the other."""
    u, v = square(size)
    woven: Field = wave(u * threads) * wave(v * threads)
    return woven


def _woven(draw: Draw, raster: Raster) -> Raster:
    """Printed or dyed colours with the weave and the fall of the cloth."""
    size = len(raster)
    threads = draw.pick(THREADS)
    yarn = noise(draw.rng, size, (6, threads), 1) + noise(draw.rng, size, (threads, 6), 1)
    return lit(raster, 0.07 * _plain_weave(size, threads) + 0.025 * yarn + _folds(draw, size))


def _folds(draw: Draw, size: int) -> Field:
    """Cloth never lies quite flat."""
    soft: Field = draw.between(0.0, 0.035) * noise(draw.rng, size, (2, 2), 2)
    return soft


def _line(turns: Field, width: float) -> Field:
    return smooth(np.abs(fraction(turns) - np.float32(0.5)), width / 2 + 0.006, width / 2 - 0.006)


def _from_middle(x: Field, y: Field) -> Field:
    a, b = fraction(x) - np.float32(0.5), fraction(y) - np.float32(0.5)
    distance: Field = np.sqrt(a * a + b * b)
    return distance
