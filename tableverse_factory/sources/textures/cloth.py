"""Cloth: linen, gingham, tartan, stripes, felt."""

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


def draw_felt(draw: TextureSampler) -> Raster:
    """Draw matted fibres of two tones."""
    base = draw.color((0.22, 0.66), (0.0, 0.15))
    fibres = draw.noise((40, 120), 2) + draw.noise((120, 40), 2)
    melange = draw.between(0.06, 0.3)
    weight = 0.5 + melange * 0.5 * fibres + 0.06 * draw.noise((6, 6), 3)
    pale = oklch(min(0.97, 0.4 + 0.66 * draw.spread(1)), 0.02, 0.0)
    raster = map_colors(weight, (scale_color(base, 0.7), base, pale))
    return brighten(raster, shade_relief(fibres, 0.05))


def _draw_bold_color(draw: TextureSampler) -> Color:
    return oklch(0.3 + 0.35 * draw.spread(4), 0.06 + 0.14 * draw.between(0, 1), draw.spread(0))


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
