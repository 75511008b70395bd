"""Sheets: metals, leather, cork, laminate, rubber, plaster, paint, chipboard."""

import numpy as np

from tableverse_factory.sources.textures.draw import Draw, oklch, rgb, shaded
from tableverse_factory.sources.textures.fields import (
    Raster,
    bell,
    cells,
    chosen,
    fraction,
    lit,
    noise,
    painted,
    ramp,
    relief,
    smooth,
    square,
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
"""Hue and the most chroma."""


def brushed_metal(draw: Draw, size: int) -> Raster:
    """Steel, brass, copper, anodised aluminium: long scratches and a soft reflection."""
    alloy, colored = METALS[int(len(METALS) * draw.spread(0))]
    base = oklch(0.4 + 0.48 * draw.spread(1), colored * draw.spread(3), alloy + draw.between(-0.02, 0.02))
    fine = noise(draw.rng, size, (2, 128), 2, 0.9) + 0.5 * noise(draw.rng, size, (6, 250), 1)
    _, v = square(size)
    glow = wave(v * draw.whole(1, 2) + np.float32(draw.between(0, 1)) + 0.06 * noise(draw.rng, size, (2, 2), 2))
    weight = 0.5 + draw.between(0.06, 0.16) * fine + draw.between(0.05, 0.2) * glow
    return ramp(weight, (shaded(base, 0.68), base, shaded(base, 1.25)))


def hammered_metal(draw: Draw, size: int) -> Raster:
    """Round dents beside one another."""
    alloy, colored = METALS[int(len(METALS) * draw.spread(0))]
    base = oklch(0.36 + 0.46 * draw.spread(1), colored * draw.spread(3), alloy + draw.between(-0.02, 0.02))
    count = (12, 18, 26, 36)[int(4 * draw.spread(2))]
    dents = cells(draw.rng, size, (count, count), 0.8)
    depth = dents.nearest * dents.nearest
    patina = noise(draw.rng, size, (3, 3), 5, 0.6)
    raster = ramp(0.5 + 0.14 * patina, (shaded(base, 0.7), base, shaded(base, 1.15)))
    return lit(raster, relief(depth, 6.0 * 18 / count) + 0.02 * noise(draw.rng, size, (80, 80), 2))


def galvanised(draw: Draw, size: int) -> Raster:
    """Zinc flowers: crystals that shine each in its own direction."""
    base = oklch(0.5 + 0.35 * draw.spread(1), 0.02 * draw.spread(3), draw.spread(0))
    count = (8, 14, 22)[int(3 * draw.spread(2))]
    crystals = cells(draw.rng, size, (count, count))
    tone = chosen(crystals.ids, draw.rng.random(crystals.count, dtype=np.float32) - np.float32(0.5))
    needles = noise(draw.rng, size, (30, 90), 2)
    weight = 0.5 + draw.between(0.25, 0.5) * tone + 0.06 * needles + 0.1 * noise(draw.rng, size, (3, 3), 3)
    return ramp(weight, (shaded(base, 0.7), base, shaded(base, 1.2)))


def patina(draw: Draw, size: int) -> Raster:
    """Rusted iron or weathered copper: a metal eaten by its oxide in blotches."""
    metal, oxide, crust = (
        (rgb("6f6a66"), rgb("8a4b24"), rgb("4a2a1c")),
        (rgb("9c6242"), rgb("5f9c8a"), rgb("3c5f58")),
        (rgb("a88c52"), rgb("6f8a6a"), rgb("4c4a34")),
    )[int(3 * draw.spread(0))]
    tint, bias = 0.75 + 0.5 * draw.spread(1), 2.4 * draw.spread(2) - 1.2
    coarse = draw.whole(2, 4)
    eaten = noise(draw.rng, size, (coarse, coarse), 7, 0.65)
    grit = noise(draw.rng, size, (60, 60), 3, 0.8)
    raster = ramp(0.5 + 0.14 * grit + 0.1 * eaten, [draw.near(shaded(metal, tint * k), 8) for k in (0.85, 1.15)])
    raster = painted(raster, draw.near(shaded(oxide, tint), 16), 0.95 * smooth(eaten + bias + 0.25 * grit, -0.2, 0.7))
    raster = painted(raster, draw.near(shaded(crust, tint), 12), 0.8 * smooth(eaten + bias + 0.4 * grit, 1.0, 2.0))
    return lit(raster, relief(eaten + 0.4 * grit, 0.22))


def tread_plate(draw: Draw, size: int) -> Raster:
    """Raised bars by turns, as on a workshop's bench."""
    base = oklch(0.35 + 0.45 * draw.spread(1), 0.06 * draw.spread(3), draw.spread(0))
    count = (8, 12, 16, 20)[int(4 * draw.spread(2))]
    u, v = square(size)
    turned = (np.floor(u * count) + np.floor(v * count)).astype(np.int32) % 2 == 0
    x, y = fraction(u * count) - np.float32(0.5), fraction(v * count) - np.float32(0.5)
    a, b = (x + y) * np.float32(0.7071), (x - y) * np.float32(0.7071)
    a, b = np.where(turned, b, a), np.where(turned, a, b)
    height = smooth(np.sqrt((a / 0.42) ** 2 + (b / 0.13) ** 2), 1.0, 0.55)
    scratches = noise(draw.rng, size, (6, 120), 2)
    raster = lit(np.broadcast_to(base, (size, size, 3)), 0.03 * scratches + 0.05 * noise(draw.rng, size, (3, 3), 4))
    return lit(raster, relief(height, 1.1) + 0.08 * height)


def leather(draw: Draw, size: int) -> Raster:
    """Grain of small scales with creases between."""
    base = oklch(0.2 + 0.55 * draw.spread(1), 0.02 + 0.1 * draw.spread(3), draw.spread(0) ** 2)
    count = (36, 52, 72)[int(3 * draw.spread(2))]
    scales = cells(draw.rng, size, (count, count), 0.9)
    height = smooth(scales.border, 0.0, 0.45)
    folds = noise(draw.rng, size, (4, 6), 5, 0.6)
    raster = ramp(0.5 + 0.14 * folds, (shaded(base, 0.68), base, shaded(base, 1.18)))
    return lit(raster, relief(height + 0.6 * folds, 0.35) - 0.22 * (1 - height))


def cork(draw: Draw, size: int) -> Raster:
    """Granules of bark, some dark."""
    base = oklch(0.5 + 0.32 * draw.spread(1), 0.05 + 0.06 * draw.spread(3), 0.14 + 0.06 * draw.spread(0))
    count = (22, 34, 50)[int(3 * draw.spread(2))]
    granules = cells(draw.rng, size, (count, count))
    values = draw.rng.random(granules.count, dtype=np.float32)
    tone = chosen(granules.ids, values)
    dark = smooth(tone, 1 - draw.between(0.03, 0.16), 1.0)
    grain = noise(draw.rng, size, (70, 70), 3, 0.8)
    raster = ramp(0.3 + 0.45 * tone + 0.09 * grain, (shaded(base, 0.78), base, shaded(base, 1.14)))
    raster = painted(raster, shaded(base, 0.4), 0.75 * dark)
    return lit(raster, -0.28 * smooth(granules.border, 0.14, 0.0) + relief(granules.border, 0.1))


def chipboard(draw: Draw, size: int) -> Raster:
    """Fine chips pressed flat, under nothing."""
    base = oklch(0.4 + 0.5 * draw.spread(1), 0.02 + 0.07 * draw.spread(3), 0.1 + 0.16 * draw.spread(0))
    raster = np.broadcast_to(base, (size, size, 3))
    count = (40, 60, 84)[int(3 * draw.spread(2))]
    for across, down in ((count, count // 2), (count // 2, count), (count, count)):
        chips = cells(draw.rng, size, (across, down))
        kept = chosen(chips.ids, draw.rng.random(chips.count) < 0.5)
        tone = chosen(chips.ids, (draw.rng.random(chips.count, dtype=np.float32) - np.float32(0.5)))
        raster = lit(raster, kept * (np.float32(0.3) * tone - 0.12 * smooth(chips.border, 0.15, 0.0)))
    return raster


def laminate(draw: Draw, size: int) -> Raster:
    """Plastic with fine flecks, as on a kitchen's worktop."""
    base = oklch(0.25 + 0.72 * draw.spread(1), 0.1 * draw.spread(3), draw.spread(0))
    raster = lit(np.broadcast_to(base, (size, size, 3)), 0.02 * noise(draw.rng, size, (6, 6), 4))
    fine = (50, 80, 120)[int(3 * draw.spread(2))]
    for _ in range(draw.whole(2, 4)):
        fleck = oklch(draw.between(0.15, 0.95), draw.between(0.0, 0.1), draw.spread(0) + draw.between(-0.2, 0.2))
        spots = noise(draw.rng, size, (fine, fine), 2, 0.6)
        limit = draw.between(0.9, 2.0)
        raster = painted(raster, fleck, draw.between(0.3, 0.9) * smooth(spots, limit, limit + 0.3))
    return raster


def rubber(draw: Draw, size: int) -> Raster:
    """A mat of studs, ribs or coins."""
    base = oklch(0.2 + 0.5 * draw.spread(1), 0.13 * draw.spread(3), draw.spread(0))
    count = (12, 18, 24, 32)[int(4 * draw.spread(2))]
    u, v = square(size)
    x, y = fraction(u * count) - np.float32(0.5), fraction(v * count) - np.float32(0.5)
    kind = draw.whole(0, 2)
    if kind == 0:
        height = smooth(np.sqrt(x * x + y * y), 0.38, 0.28)
    elif kind == 1:
        height = smooth(np.abs(x), 0.32, 0.2)
    else:
        height = smooth(np.abs(x) + np.abs(y), 0.42, 0.3)
    dust = noise(draw.rng, size, (4, 4), 5, 0.65)
    raster = lit(np.broadcast_to(base, (size, size, 3)), 0.05 * dust + 0.04 * noise(draw.rng, size, (128, 128), 1))
    return lit(raster, relief(height, 0.9) + 0.1 * (height - 0.5))


def plaster(draw: Draw, size: int) -> Raster:
    """Trowelled microcement or lime: sweeping strokes of two tones."""
    base = oklch(0.4 + 0.53 * draw.spread(1), 0.07 * draw.spread(3), draw.spread(0))
    count = (3, 5, 8)[int(3 * draw.spread(2))]
    strokes = wave(0.5 * noise(draw.rng, size, (count, count), 6, 0.6)) + 0.4 * noise(draw.rng, size, (4, 60), 2)
    clouds = noise(draw.rng, size, (3, 3), 5, 0.55)
    weight = 0.5 + draw.between(0.05, 0.14) * strokes + draw.between(0.06, 0.16) * clouds
    raster = ramp(weight, (shaded(base, 0.76), base, shaded(base, 1.14)))
    return lit(raster, relief(strokes + clouds, 0.1))


def lacquer(draw: Draw, size: int) -> Raster:
    """One colour of paint, brushed or sprayed, with the marks of use."""
    base = oklch(0.2 + 0.77 * draw.spread(1), 0.2 * draw.spread(3), draw.spread(0))
    brush = noise(draw.rng, size, (2, 90), 2, 0.8) * draw.pick((0.0, 0.012, 0.03))
    clouds = noise(draw.rng, size, (3, 3), 4) * (0.01 + 0.06 * draw.spread(2))
    raster = lit(np.broadcast_to(base, (size, size, 3)), brush + clouds)
    scratches = bell(noise(draw.rng, size, (3, 5), 4, 0.5), 0.006) * smooth(noise(draw.rng, size, (4, 4), 2), 0.5, 1.6)
    return lit(raster, draw.pick((0.0, 0.15, -0.2)) * scratches)
