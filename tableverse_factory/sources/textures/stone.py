"""Stone: marble, granite, terrazzo, travertine, concrete."""

from collections.abc import Sequence

import numpy as np

from tableverse_factory.sources.textures.draw import TextureSampler, map_shades, oklch, parse_hex, scale_color
from tableverse_factory.sources.textures.fields import (
    Color,
    Field,
    Raster,
    bell,
    brighten,
    map_colors,
    paint,
    shade_relief,
    smoothstep,
)

MARBLES: tuple[tuple[str, str, str], ...] = (
    ("f2f0ec", "d5d5d6", "7f858c"),  # white, grey veins
    ("f6f2ea", "e2d9c8", "b18a4e"),  # white, gold veins
    ("26262a", "3a3a40", "e4e0d8"),  # black, white veins
    ("2f4a3c", "47685a", "c9d8c6"),  # green
    ("7a3b33", "93544a", "e6cfc0"),  # red
    ("5f4634", "7b5c46", "d8c2a4"),  # brown
    ("e8d9bd", "d9c29c", "a97f4c"),  # cream
    ("3c4a63", "546785", "cfd6de"),  # blue
    ("d9bdb3", "c9a59a", "8f5f58"),  # pink
    ("8c8f92", "a2a5a8", "eceded"),  # grey
    ("1f2f33", "2f484c", "b59a5a"),  # dark teal, gold veins
)
"""Ground, clouds, veins."""


def draw_marble(draw: TextureSampler) -> Raster:
    """Draw clouds, a few strong veins, many hair-fine ones."""
    tint = 0.88 + 0.22 * draw.spread(1)
    ground, cloud, vein = (draw.near(scale_color(parse_hex(c), tint), 10) for c in draw.choose(MARBLES, 0))
    warp = draw.noise((2, 2), 5, 0.55)
    coarse = draw.choose((2, 3, 4))
    clouds = draw.noise((coarse, coarse), 5, 0.55)
    raster = map_colors(0.45 + 0.3 * clouds, (scale_color(ground, 1.03), ground, cloud))
    for cell, width, strength in ((coarse, 0.07, 0.85), (2 * coarse, 0.05, 0.4), (4 * coarse, 0.05, 0.2)):
        path = draw.noise((cell, cell), 4, 0.5) + 0.6 * warp
        fade = smoothstep(draw.noise((coarse, coarse), 2), -0.7, 1.0)
        thin = width * draw.between(0.5, 1.5)
        raster = paint(raster, vein, strength * fade * (0.75 * bell(path, thin) + 0.25 * bell(path, 5 * thin)))
    return brighten(raster, 0.01 * draw.noise((90, 90), 2))


def draw_granite(draw: TextureSampler) -> Raster:
    """Draw grains of three or four minerals."""
    hue, bright = draw.spread(0), 0.3 + 0.55 * draw.spread(1)
    ground = oklch(bright, 0.05 * draw.spread(3), hue)
    minerals = (
        oklch(min(0.95, bright + draw.between(0.12, 0.3)), 0.02, hue + 0.1),
        oklch(max(0.1, bright - draw.between(0.2, 0.35)), 0.02, hue + 0.5),
        oklch(bright - 0.08, 0.03 + 0.07 * draw.spread(3), hue - 0.06),
    )
    grains = draw.choose((56, 84, 120))
    raster = map_colors(0.5 + 0.22 * draw.noise((grains, grains), 3, 0.8), (scale_color(ground, 0.8), ground))
    for mineral in minerals:
        drift = 0.4 * draw.noise((4, 4), 2)
        spots = draw.noise((grains, grains), 2, 0.7) + drift
        limit = draw.between(0.4, 1.1)
        raster = paint(raster, mineral, 0.92 * smoothstep(spots, limit, limit + 0.25))
    return raster


def draw_terrazzo(draw: TextureSampler) -> Raster:
    """Draw chips of several stones in a ground."""
    ground = draw.color((0.25, 0.7), (0.0, 0.07))
    lively, hue = draw.between(0.01, 0.1), draw.spread(4)
    parts = ((draw.between(0.25, 0.95), draw.between(0.2, 1.0), draw.between(-0.18, 0.18)) for _ in range(5))
    stones = [oklch(light, lively * share, hue + turn) for light, share, turn in parts]
    raster = brighten(draw.fill(ground), 0.025 * draw.noise((70, 70), 3, 0.8))
    coarse = draw.choose((7, 10, 14, 20))
    for count, share in ((3 * coarse, 0.45), (2 * coarse, 0.5), (coarse, draw.between(0.5, 0.95))):
        raster = _draw_chips(draw, raster, count, share, stones)
    return raster


def _draw_chips(draw: TextureSampler, raster: Raster, count: int, share: float, stones: Sequence[Color]) -> Raster:
    chips = draw.cells(count, count)
    kept = (draw.rng.random(chips.count) < share)[chips.ids]
    gap = (draw.rng.random(chips.count, dtype=np.float32) * np.float32(0.3) + np.float32(0.16))[chips.ids]
    rough = 0.035 * draw.noise((5 * count, 5 * count), 2)
    inside = smoothstep(chips.border - gap + rough, -0.03, 0.03) * kept
    kinds = draw.rng.integers(0, len(stones), chips.count)
    tint = draw.each(chips.count, 0.08)
    colors = np.asarray(stones, dtype=np.float32)[kinds] * (1 + tint)[:, None]
    return raster + (colors[chips.ids] - raster) * inside[..., None]


def draw_travertine(draw: TextureSampler) -> Raster:
    """Draw level beds with rows of pits."""
    base = draw.color((0.6, 0.32), (0.02, 0.05), (0.12, 0.14))
    beds = draw.noise((1, draw.choose((5, 8, 12))), 5, 0.65)
    fine = draw.noise((5, 70), 3, 0.7)
    raster = map_shades(0.5 + 0.17 * beds + 0.07 * fine, base, 0.78, 1.1)
    pits = draw.noise((48, 110), 2, 0.6) + 0.8 * draw.noise((2, 14), 2)
    deep = smoothstep(pits, draw.between(1.8, 2.4), 2.8)
    return brighten(paint(raster, scale_color(base, 0.5), 0.8 * deep), shade_relief(-deep, 0.25))


def draw_concrete(draw: TextureSampler) -> Raster:
    """Draw cast or trowelled concrete: clouds, stains, small pores."""
    base = draw.color((0.38, 0.5), (0.0, 0.024))
    trowel = draw.choose((1, 2, 4))
    clouds = draw.noise((3, 3 * trowel), 6, 0.6)
    grit = draw.noise((100, 100), 2, 0.9)
    raster = map_shades(0.5 + draw.between(0.1, 0.24) * clouds + 0.05 * grit, base, 0.7, 1.2)
    pores = smoothstep(draw.noise((56, 56), 2), draw.between(2.2, 2.8), 3.1)
    lines = _draw_cracks(draw) if draw.chance(0.3) else np.zeros((draw.size, draw.size), dtype=np.float32)
    return brighten(raster, shade_relief(-pores, 0.4) - 0.35 * pores - 0.4 * lines)


def _draw_cracks(draw: TextureSampler) -> Field:
    path = draw.noise((2, 2), 6, 0.6)
    return bell(path, 0.008) * smoothstep(draw.noise((2, 2), 2), 0.0, 0.8)
