"""Sheets: metals, leather, cork, laminate, rubber, plaster, paint, chipboard."""

import numpy as np

from tableverse_factory.sources.textures.draw import TextureSampler, map_shades, oklch, parse_hex, scale_color
from tableverse_factory.sources.textures.fields import (
    Color,
    Raster,
    bell,
    brighten,
    map_colors,
    paint,
    pixel_grid,
    shade_relief,
    smoothstep,
    take_fraction,
    wave,
)

METALS: tuple[tuple[float, float], ...] = (
    (0.70, 0.02),  # steel
    (0.24, 0.09),  # brass
    (0.14, 0.09),  # copper
    (0.18, 0.06),  # bronze
    (0.66, 0.03),  # zinc
    (0.72, 0.10),  # anodised blue
    (0.08, 0.10),  # anodised red
    (0.30, 0.05),  # champagne
)
"""Hue and greatest chroma."""


def draw_brushed_metal(draw: TextureSampler) -> Raster:
    """Draw steel, brass, copper, anodised aluminium: long scratches and a soft reflection."""
    base = _draw_metal_color(draw, 0.4, 0.48)
    fine = draw.noise((2, 128), 2, 0.9) + 0.5 * draw.noise((6, 250), 1)
    _, v = pixel_grid(draw.size)
    glow = wave(v * draw.whole(1, 2) + np.float32(draw.between(0, 1)) + 0.06 * draw.noise((2, 2), 2))
    weight = 0.5 + draw.between(0.06, 0.16) * fine + draw.between(0.05, 0.2) * glow
    return map_shades(weight, base, 0.68, 1.25)


def draw_hammered_metal(draw: TextureSampler) -> Raster:
    """Draw round dents beside one another."""
    base = _draw_metal_color(draw, 0.36, 0.46)
    count = draw.choose((12, 18, 26, 36))
    dents = draw.cells(count, count, 0.8)
    depth = dents.nearest * dents.nearest
    patina = draw.noise((3, 3), 5, 0.6)
    raster = map_shades(0.5 + 0.14 * patina, base, 0.7, 1.15)
    return brighten(raster, shade_relief(depth, 6.0 * 18 / count) + 0.02 * draw.noise((80, 80), 2))


def draw_galvanised(draw: TextureSampler) -> Raster:
    """Draw zinc flowers: crystals that shine each in its own direction."""
    base = draw.color((0.5, 0.35), (0.0, 0.02))
    count = draw.choose((8, 14, 22))
    crystals = draw.cells(count, count)
    tone = draw.each(crystals.count, 0.5)[crystals.ids]
    needles = draw.noise((30, 90), 2)
    weight = 0.5 + draw.between(0.25, 0.5) * tone + 0.06 * needles + 0.1 * draw.noise((3, 3), 3)
    return map_shades(weight, base, 0.7, 1.2)


def draw_patina(draw: TextureSampler) -> Raster:
    """Draw rusted iron or weathered copper: a metal eaten by its oxide in blotches."""
    metal, oxide, crust = (
        (parse_hex("6f6a66"), parse_hex("8a4b24"), parse_hex("4a2a1c")),
        (parse_hex("9c6242"), parse_hex("5f9c8a"), parse_hex("3c5f58")),
        (parse_hex("a88c52"), parse_hex("6f8a6a"), parse_hex("4c4a34")),
    )[int(3 * draw.spread(0))]
    tint, bias = 0.75 + 0.5 * draw.spread(1), 2.4 * draw.spread(2) - 1.2
    coarse = draw.whole(2, 4)
    eaten = draw.noise((coarse, coarse), 7, 0.65)
    grit = draw.noise((60, 60), 3, 0.8)
    metals = [draw.near(scale_color(metal, tint * k), 8) for k in (0.85, 1.15)]
    raster, depth = map_colors(0.5 + 0.14 * grit + 0.1 * eaten, metals), eaten + bias
    raster = paint(raster, draw.near(scale_color(oxide, tint), 16), 0.95 * smoothstep(depth + 0.25 * grit, -0.2, 0.7))
    raster = paint(raster, draw.near(scale_color(crust, tint), 12), 0.8 * smoothstep(depth + 0.4 * grit, 1.0, 2.0))
    return brighten(raster, shade_relief(eaten + 0.4 * grit, 0.22))


def draw_tread_plate(draw: TextureSampler) -> Raster:
    """Draw raised bars by turns, as on a workshop's bench."""
    base = draw.color((0.35, 0.45), (0.0, 0.06))
    count = draw.choose((8, 12, 16, 20))
    u, v = pixel_grid(draw.size)
    turned = (np.floor(u * count) + np.floor(v * count)).astype(np.int32) % 2 == 0
    x, y = take_fraction(u * count) - np.float32(0.5), take_fraction(v * count) - np.float32(0.5)
    a, b = (x + y) * np.float32(0.7071), (x - y) * np.float32(0.7071)
    a, b = np.where(turned, b, a), np.where(turned, a, b)
    height = smoothstep(np.sqrt((a / 0.42) ** 2 + (b / 0.13) ** 2), 1.0, 0.55)
    scratches = draw.noise((6, 120), 2)
    raster = brighten(draw.fill(base), 0.03 * scratches + 0.05 * draw.noise((3, 3), 4))
    return brighten(raster, shade_relief(height, 1.1) + 0.08 * height)


def draw_leather(draw: TextureSampler) -> Raster:
    """Draw a grain of small scales with creases between."""
    base = oklch(0.2 + 0.55 * draw.spread(1), 0.02 + 0.1 * draw.spread(3), draw.spread(0) ** 2)
    count = draw.choose((36, 52, 72))
    scales = draw.cells(count, count, 0.9)
    height = smoothstep(scales.border, 0.0, 0.45)
    folds = draw.noise((4, 6), 5, 0.6)
    raster = map_shades(0.5 + 0.14 * folds, base, 0.68, 1.18)
    return brighten(raster, shade_relief(height + 0.6 * folds, 0.35) - 0.22 * (1 - height))


def draw_cork(draw: TextureSampler) -> Raster:
    """Draw granules of bark, some dark."""
    base = draw.color((0.5, 0.32), (0.05, 0.06), (0.14, 0.06))
    count = draw.choose((22, 34, 50))
    granules = draw.cells(count, count)
    values = draw.rng.random(granules.count, dtype=np.float32)
    tone = values[granules.ids]
    dark = smoothstep(tone, 1 - draw.between(0.03, 0.16), 1.0)
    grain = draw.noise((70, 70), 3, 0.8)
    raster = map_shades(0.3 + 0.45 * tone + 0.09 * grain, base, 0.78, 1.14)
    raster = paint(raster, scale_color(base, 0.4), 0.75 * dark)
    return brighten(raster, -0.28 * smoothstep(granules.border, 0.14, 0.0) + shade_relief(granules.border, 0.1))


def draw_chipboard(draw: TextureSampler) -> Raster:
    """Draw fine chips pressed flat."""
    base = draw.color((0.4, 0.5), (0.02, 0.07), (0.1, 0.16))
    raster = draw.fill(base)
    count = draw.choose((40, 60, 84))
    for across, down in ((count, count // 2), (count // 2, count), (count, count)):
        chips = draw.cells(across, down)
        kept = (draw.rng.random(chips.count) < 0.5)[chips.ids]
        tone = draw.each(chips.count, 0.5)[chips.ids]
        raster = brighten(raster, kept * (np.float32(0.3) * tone - 0.12 * smoothstep(chips.border, 0.15, 0.0)))
    return raster


def draw_laminate(draw: TextureSampler) -> Raster:
    """Draw plastic with fine flecks, as on a kitchen's worktop."""
    base = draw.color((0.25, 0.72), (0.0, 0.1))
    raster = brighten(draw.fill(base), 0.02 * draw.noise((6, 6), 4))
    fine = draw.choose((50, 80, 120))
    for _ in range(draw.whole(2, 4)):
        fleck = oklch(draw.between(0.15, 0.95), draw.between(0.0, 0.1), draw.spread(0) + draw.between(-0.2, 0.2))
        spots = draw.noise((fine, fine), 2, 0.6)
        limit = draw.between(0.9, 2.0)
        raster = paint(raster, fleck, draw.between(0.3, 0.9) * smoothstep(spots, limit, limit + 0.3))
    return raster


def draw_rubber(draw: TextureSampler) -> Raster:
    """Draw a mat of studs, ribs or coins."""
    base = draw.color((0.2, 0.5), (0.0, 0.13))
    count = draw.choose((12, 18, 24, 32))
    u, v = pixel_grid(draw.size)
    x, y = take_fraction(u * count) - np.float32(0.5), take_fraction(v * count) - np.float32(0.5)
    kind = draw.whole(0, 2)
    if kind == 0:
        height = smoothstep(np.sqrt(x * x + y * y), 0.38, 0.28)
    elif kind == 1:
        height = smoothstep(np.abs(x), 0.32, 0.2)
    else:
        height = smoothstep(np.abs(x) + np.abs(y), 0.42, 0.3)
    dust = draw.noise((4, 4), 5, 0.65)
    raster = brighten(draw.fill(base), 0.05 * dust + 0.04 * draw.noise((128, 128), 1))
    return brighten(raster, shade_relief(height, 0.9) + 0.1 * (height - 0.5))


def draw_plaster(draw: TextureSampler) -> Raster:
    """Draw trowelled microcement or lime: sweeping strokes of two tones."""
    base = draw.color((0.4, 0.53), (0.0, 0.07))
    count = draw.choose((3, 5, 8))
    strokes = wave(0.5 * draw.noise((count, count), 6, 0.6)) + 0.4 * draw.noise((4, 60), 2)
    clouds = draw.noise((3, 3), 5, 0.55)
    weight = 0.5 + draw.between(0.05, 0.14) * strokes + draw.between(0.06, 0.16) * clouds
    raster = map_shades(weight, base, 0.76, 1.14)
    return brighten(raster, shade_relief(strokes + clouds, 0.1))


def draw_lacquer(draw: TextureSampler) -> Raster:
    """Draw one colour of paint, brushed or sprayed, with the marks of use."""
    base = draw.color((0.2, 0.77), (0.0, 0.2))
    brush = draw.noise((2, 90), 2, 0.8) * draw.pick((0.0, 0.012, 0.03))
    clouds = draw.noise((3, 3), 4) * (0.01 + 0.06 * draw.spread(2))
    raster = brighten(draw.fill(base), brush + clouds)
    scratches = bell(draw.noise((3, 5), 4, 0.5), 0.006) * smoothstep(draw.noise((4, 4), 2), 0.5, 1.6)
    return brighten(raster, draw.pick((0.0, 0.15, -0.2)) * scratches)


def _draw_metal_color(draw: TextureSampler, dark: float, extent: float) -> Color:
    hue, chroma = draw.choose(METALS, 0)
    return oklch(dark + extent * draw.spread(1), chroma * draw.spread(3), hue + draw.between(-0.02, 0.02))
