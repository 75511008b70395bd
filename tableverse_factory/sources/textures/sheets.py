"""Sheets: brushed metal, leather, laminate, plaster, lacquer."""

import numpy as np

from tableverse_factory.sources.textures.draw import TextureSampler, map_shades, oklch
from tableverse_factory.sources.textures.fields import (
    Color,
    Raster,
    bell,
    brighten,
    paint,
    pixel_grid,
    shade_relief,
    smoothstep,
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


def draw_leather(draw: TextureSampler) -> Raster:
    """Draw a grain of small scales with creases between."""
    base = oklch(0.2 + 0.55 * draw.spread(1), 0.02 + 0.1 * draw.spread(3), draw.spread(0) ** 2)
    count = draw.choose((36, 52, 72))
    scales = draw.cells(count, count, 0.9)
    height = smoothstep(scales.border, 0.0, 0.45)
    folds = draw.noise((4, 6), 5, 0.6)
    raster = map_shades(0.5 + 0.14 * folds, base, 0.68, 1.18)
    return brighten(raster, shade_relief(height + 0.6 * folds, 0.35) - 0.22 * (1 - height))


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
