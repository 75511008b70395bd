"""Cloth: linen, gingham, tartan, stripes, twill, houndstooth, dots, felt, wicker."""

import numpy as np

from tableverse_factory.sources.textures.draw import TextureSampler, map_shades, oklch, scale_color
from tableverse_factory.sources.textures.fields import (
    Color,
    Field,
    Raster,
    brighten,
    map_colors,
    paint,
    pixel_centers,
    pixel_grid,
    shade_relief,
    smoothstep,
    take_fraction,
    wave,
)

THREADS = (96, 128, 160)  # Threads across the square


def draw_linen(draw: TextureSampler) -> Raster:
    """Draw a plain weave of uneven threads."""
    base = oklch(0.3 + 0.63 * draw.spread(1), 0.14 * draw.spread(3) ** 2, draw.spread(0))
    threads = draw.choose(THREADS)
    slubs = draw.noise((5, threads), 1) + draw.noise((threads, 5), 1)
    raster = map_shades(0.5 + draw.between(0.08, 0.2) * slubs, base, 0.74, 1.16)
    return brighten(raster, 0.09 * _make_plain_weave(draw, threads) + _draw_folds(draw))


def draw_gingham(draw: TextureSampler) -> Raster:
    """Draw checks of equal stripes."""
    color, ground = _draw_bold_color(draw), oklch(draw.between(0.9, 0.98), draw.between(0, 0.03), draw.between(0, 1))
    checks = draw.choose((6, 8, 12, 16, 24))
    u, v = pixel_grid(draw.size)
    across, down = (smoothstep(wave(t * checks), -0.03, 0.03) for t in (u, v))
    raster = paint(draw.fill(ground), color, 0.48 * (across + down))
    return _add_weave(draw, raster)


def draw_windowpane(draw: TextureSampler) -> Raster:
    """Draw thin lines of one or two colours on a ground."""
    ground = draw.color((0.25, 0.68), (0.0, 0.12))
    line, second = _draw_bold_color(draw, 0.5), _draw_contrast_color(draw, ground)
    count = draw.choose((4, 6, 8, 10))
    u, v = pixel_grid(draw.size)
    raster = draw.fill(ground)
    for t in (u, v):
        raster = paint(raster, line, 0.8 * _make_line(t * count, 0.09))
        raster = paint(raster, second, 0.7 * _make_line(t * count + np.float32(0.5), 0.04))
    return _add_weave(draw, raster)


def draw_tartan(draw: TextureSampler) -> Raster:
    """Draw a symmetric sett of stripes, the same both ways, in twill."""
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
    repeats = draw.choose((2, 3, 4))
    place = (pixel_centers(draw.size) * repeats % 1 * len(sett)).astype(np.intp)
    stripe = np.asarray(colors, dtype=np.float32)[sett[place]]
    u, v = pixel_grid(draw.size)
    warp_on_top = (0.5 + 0.5 * wave((u + v) * 128))[..., None]
    share = 0.5 + 0.16 * (warp_on_top - 0.5) * 2
    raster: Raster = share * stripe[None, :] + (1 - share) * stripe[:, None]
    return brighten(raster, 0.04 * draw.noise((90, 90), 2) + _draw_folds(draw))


def draw_stripes(draw: TextureSampler) -> Raster:
    """Draw ticking: stripes of several widths along one side."""
    ground = draw.color((0.55, 0.42), (0.0, 0.06))
    colors = [_draw_bold_color(draw), _draw_contrast_color(draw, ground), scale_color(ground, 0.8)]
    repeats = draw.choose((3, 4, 6, 8))
    u, _ = pixel_grid(draw.size)
    t = take_fraction(u * repeats)
    raster = draw.fill(ground)
    for color in colors[: draw.whole(2, 3)]:
        middle, half = np.float32(draw.between(0.1, 0.9)), draw.between(0.02, 0.16)
        distance = np.abs(take_fraction(t - middle + np.float32(0.5)) - np.float32(0.5))
        raster = paint(raster, color, smoothstep(distance, half + 0.01, half))
    return _add_weave(draw, raster if draw.chance(0.5) else raster.transpose(1, 0, 2))


def draw_twill(draw: TextureSampler) -> Raster:
    """Draw denim and its kin: diagonal ribs, pale threads showing through, worn places."""
    base = draw.color((0.25, 0.5), (0.02, 0.1))
    pale = oklch(draw.between(0.75, 0.92), 0.02, draw.between(0, 1))
    threads = draw.choose(THREADS)
    u, v = pixel_grid(draw.size)
    ribs = wave((u + v) * (threads // 2)) + 0.5 * wave((u - 2 * v) * threads)
    yarn = draw.noise((threads, 4), 1) + 0.6 * draw.noise((threads, 40), 1)
    worn = draw.noise((2, 2), 3)
    weight = 0.24 + 0.13 * ribs + 0.1 * yarn + draw.between(0.03, 0.12) * worn
    return map_colors(weight, (scale_color(base, 0.8), base, pale))


def draw_houndstooth(draw: TextureSampler) -> Raster:
    """Draw four dark and four light threads, both ways, in a two-over-two twill, which gives the broken check."""
    light = oklch(0.72 + 0.26 * draw.spread(1), 0.1 * draw.spread(3), draw.spread(0) + 0.5)
    dark = oklch(0.15 + 0.35 * draw.spread(4), 0.13 * draw.spread(3), draw.spread(0))
    repeats = draw.choose((6, 8, 12, 16))
    u, v = pixel_grid(draw.size)
    i, j = (np.floor(t * (8 * repeats)).astype(np.int32) for t in (u, v))
    warp_on_top = (i - j) % 4 < 2
    weight = np.where(warp_on_top, i % 8 < 4, j % 8 < 4).astype(np.float32)
    return _add_weave(draw, map_colors(weight, (light, dark)))


def draw_dots(draw: TextureSampler) -> Raster:
    """Draw polka dots in a staggered grid."""
    ground = draw.color((0.25, 0.7), (0.0, 0.15))
    color = _draw_contrast_color(draw, ground)
    count = draw.choose((6, 8, 12, 18))
    u, v = pixel_grid(draw.size)
    radius = draw.between(0.18, 0.36)
    distance = np.minimum(*(_measure_from_middle(u * count + shift, v * count + shift) for shift in (0.0, 0.5)))
    raster = paint(draw.fill(ground), color, smoothstep(distance, radius + 0.03, radius - 0.03))
    return _add_weave(draw, raster)


def draw_felt(draw: TextureSampler) -> Raster:
    """Draw matted fibres of two tones."""
    base = draw.color((0.22, 0.66), (0.0, 0.15))
    fibres = draw.noise((40, 120), 2) + draw.noise((120, 40), 2)
    melange = draw.between(0.06, 0.3)
    weight = 0.5 + melange * 0.5 * fibres + 0.06 * draw.noise((6, 6), 3)
    pale = oklch(min(0.97, 0.4 + 0.66 * draw.spread(1)), 0.02, 0.0)
    raster = map_colors(weight, (scale_color(base, 0.7), base, pale))
    return brighten(raster, shade_relief(fibres, 0.05))


def draw_tweed(draw: TextureSampler) -> Raster:
    """Draw a herringbone of two yarns with coloured flecks."""
    dark = draw.color((0.2, 0.35), (0.0, 0.07))
    light = oklch(0.55 + 0.35 * draw.spread(4), 0.05 * draw.spread(3), draw.spread(0) + 0.08)
    columns = draw.choose((8, 12, 16, 24))
    u, v = pixel_grid(draw.size)
    zigzag = np.abs(take_fraction(u * (columns // 2)) - np.float32(0.5)) * np.float32(8 * 24 / columns)
    ribs = wave(v * 64 + zigzag)
    yarn = draw.noise((100, 100), 2, 0.9)
    raster = map_colors(0.5 + 0.36 * ribs + 0.14 * yarn, (dark, light))
    flecks = smoothstep(draw.noise((60, 40), 2), 2.0, 2.6)
    return paint(raster, oklch(0.65, 0.14, draw.between(0, 1)), flecks)


def draw_wicker(draw: TextureSampler) -> Raster:
    """Draw strands over and under pairs of stakes."""
    base = draw.color((0.35, 0.5), (0.02, 0.07), (0.08, 0.16))
    down, right = draw.choose((20, 28, 36)), draw.choose((8, 12, 16), 4)
    u, v = pixel_grid(draw.size)
    row = np.floor(v * down).astype(np.int32)
    inside = take_fraction(v * down) * 2 - 1
    over = wave(u * (right // 2) + 0.5 * (row % 2).astype(np.float32))
    round_strand = np.sqrt(np.maximum(1 - inside * inside, 0))
    shade = 0.35 * (round_strand - 0.7) + 0.3 * (over - 0.2) * round_strand
    tone = draw.each(down, 0.08)[row]
    grain = draw.noise((12, 4 * down), 2)
    gap = smoothstep(over, -0.55, -0.9) * 0.35
    raster = map_shades(0.5 + 0.1 * grain + tone, base, 0.75, 1.15)
    return brighten(raster, np.clip(shade - gap - 0.3 * smoothstep(round_strand, 0.4, 0.0), -0.85, 0.5))


def _draw_bold_color(draw: TextureSampler, bright: float = 0.3) -> Color:
    return oklch(bright + 0.35 * draw.spread(4), 0.06 + 0.14 * draw.between(0, 1), draw.spread(0))


def _draw_contrast_color(draw: TextureSampler, ground: Color) -> Color:
    bright = draw.between(0.2, 0.45) if float(ground.sum()) > 3 * 128 else draw.between(0.75, 0.97)
    return oklch(bright, draw.between(0.02, 0.16), draw.between(0, 1))


def _make_plain_weave(draw: TextureSampler, threads: int) -> Field:
    u, v = pixel_grid(draw.size)
    return wave(u * threads) * wave(v * threads)


def _add_weave(draw: TextureSampler, raster: Raster) -> Raster:
    threads = draw.pick(THREADS)
    yarn = draw.noise((6, threads), 1) + draw.noise((threads, 6), 1)
    return brighten(raster, 0.07 * _make_plain_weave(draw, threads) + 0.025 * yarn + _draw_folds(draw))


def _draw_folds(draw: TextureSampler) -> Field:
    return draw.between(0.0, 0.035) * draw.noise((2, 2), 2)


def _make_line(turns: Field, width: float) -> Field:
    return smoothstep(np.abs(take_fraction(turns) - np.float32(0.5)), width / 2 + 0.006, width / 2 - 0.006)


def _measure_from_middle(x: Field, y: Field) -> Field:
    a, b = take_fraction(x) - np.float32(0.5), take_fraction(y) - np.float32(0.5)
    return np.sqrt(a * a + b * b)
