"""Stone: marble, granite, terrazzo, travertine, slate, onyx, sandstone, concrete."""

from collections.abc import Sequence

import numpy as np

from tableverse_factory.sources.textures.draw import Draw, oklch, rgb, shaded
from tableverse_factory.sources.textures.fields import (
    Color,
    Field,
    Raster,
    bell,
    cells,
    chosen,
    lit,
    noise,
    painted,
    ramp,
    relief,
    smooth,
    square,
    wave,
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


def marble(draw: Draw, size: int) -> Raster:
    """Clouds, a few strong veins, many hair-fine ones."""
    ground, cloud, vein = _colors(draw, MARBLES)
    warp = noise(draw.rng, size, (2, 2), 5, 0.55)
    coarse = (2, 3, 4)[int(3 * draw.spread(2))]
    clouds = noise(draw.rng, size, (coarse, coarse), 5, 0.55)
    raster = ramp(0.45 + 0.3 * clouds, (shaded(ground, 1.03), ground, cloud))
    for cell, width, strength in ((coarse, 0.07, 0.85), (2 * coarse, 0.05, 0.4), (4 * coarse, 0.05, 0.2)):
        path = noise(draw.rng, size, (cell, cell), 4, 0.5) + 0.6 * warp
        fade = smooth(noise(draw.rng, size, (coarse, coarse), 2), -0.7, 1.0)
        thin = width * draw.between(0.5, 1.5)
        raster = painted(raster, vein, strength * fade * (0.75 * bell(path, thin) + 0.25 * bell(path, 5 * thin)))
    return lit(raster, 0.01 * noise(draw.rng, size, (90, 90), 2))


def onyx(draw: Draw, size: int) -> Raster:
    """Bands of translucent colour, folded."""
    hue, chroma = draw.spread(0), 0.03 + 0.1 * draw.spread(3)
    bright = 0.45 + 0.4 * draw.spread(1)
    fold = noise(draw.rng, size, (2, 2), 5, 0.5)
    u, v = square(size)
    turns = v * draw.whole(1, 3) + u * draw.whole(0, 2) + draw.between(0.3, 0.7) * fold
    bands = 0.5 + 0.3 * wave(turns) + 0.14 * wave(3 * turns + 0.3 * fold) + 0.09 * wave(9 * turns + fold)
    stops = [
        oklch(min(0.97, bright + shift), chroma * share, hue + turn)
        for shift, share, turn in ((-0.2, 1.2, 0.04), (0.0, 1.0, 0.0), (0.16, 0.6, -0.03), (0.3, 0.3, -0.05))
    ]
    return lit(ramp(bands, stops), 0.015 * noise(draw.rng, size, (60, 60), 2))


def granite(draw: Draw, size: int) -> Raster:
    """Grains of three or four minerals."""
    hue, bright = draw.spread(0), 0.3 + 0.55 * draw.spread(1)
    ground = oklch(bright, 0.05 * draw.spread(3), hue)
    minerals = (
        oklch(min(0.95, bright + draw.between(0.12, 0.3)), 0.02, hue + 0.1),
        oklch(max(0.1, bright - draw.between(0.2, 0.35)), 0.02, hue + 0.5),
        oklch(bright - 0.08, 0.03 + 0.07 * draw.spread(3), hue - 0.06),
    )
    grains = (56, 84, 120)[int(3 * draw.spread(2))]
    raster = ramp(0.5 + 0.22 * noise(draw.rng, size, (grains, grains), 3, 0.8), (shaded(ground, 0.8), ground))
    for mineral in minerals:
        drift = 0.4 * noise(draw.rng, size, (4, 4), 2)
        spots = noise(draw.rng, size, (grains, grains), 2, 0.7) + drift
        limit = draw.between(0.4, 1.1)
        raster = painted(raster, mineral, 0.92 * smooth(spots, limit, limit + 0.25))
    return raster


def terrazzo(draw: Draw, size: int) -> Raster:
    """Chips of several stones in a ground."""
    ground = oklch(0.25 + 0.7 * draw.spread(1), 0.07 * draw.spread(3), draw.spread(0))
    lively, hue = draw.between(0.01, 0.1), draw.spread(4)
    stones = [
        oklch(draw.between(0.25, 0.95), lively * draw.between(0.2, 1.0), hue + draw.between(-0.18, 0.18))
        for _ in range(5)
    ]
    raster = lit(np.broadcast_to(ground, (size, size, 3)), 0.025 * noise(draw.rng, size, (70, 70), 3, 0.8))
    coarse = (7, 10, 14, 20)[int(4 * draw.spread(2))]
    for count, share in ((3 * coarse, 0.45), (2 * coarse, 0.5), (coarse, draw.between(0.5, 0.95))):
        raster = _chips(draw, raster, count, share, stones)
    return raster


def _chips(draw: Draw, raster: Raster, count: int, share: float, stones: Sequence[Color]) -> Raster:
    size = len(raster)
    chips = cells(draw.rng, size, (count, count))
    kept = chosen(chips.ids, draw.rng.random(chips.count) < share)
    gap = chosen(chips.ids, draw.rng.random(chips.count, dtype=np.float32) * np.float32(0.3) + np.float32(0.16))
    rough = 0.035 * noise(draw.rng, size, (5 * count, 5 * count), 2)
    inside = smooth(chips.border - gap + rough, -0.03, 0.03) * kept
    kinds = draw.rng.integers(0, len(stones), chips.count)
    tint = (draw.rng.random(chips.count, dtype=np.float32) - np.float32(0.5)) * np.float32(0.16)
    colors = np.asarray(stones, dtype=np.float32)[kinds] * (1 + tint)[:, None]
    covered: Raster = raster + (chosen(chips.ids, colors) - raster) * inside[..., None]
    return covered


def travertine(draw: Draw, size: int) -> Raster:
    """Level beds with rows of pits."""
    base = oklch(0.6 + 0.32 * draw.spread(1), 0.02 + 0.05 * draw.spread(3), 0.12 + 0.14 * draw.spread(0))
    beds = noise(draw.rng, size, (1, (5, 8, 12)[int(3 * draw.spread(2))]), 5, 0.65)
    fine = noise(draw.rng, size, (5, 70), 3, 0.7)
    raster = ramp(0.5 + 0.17 * beds + 0.07 * fine, (shaded(base, 0.78), base, shaded(base, 1.1)))
    pits = noise(draw.rng, size, (48, 110), 2, 0.6) + 0.8 * noise(draw.rng, size, (2, 14), 2)
    deep = smooth(pits, draw.between(1.8, 2.4), 2.8)
    return lit(painted(raster, shaded(base, 0.5), 0.8 * deep), relief(-deep, 0.25))


def sandstone(draw: Draw, size: int) -> Raster:
    """Grains of sand in faint, wavy beds."""
    base = oklch(0.5 + 0.4 * draw.spread(1), 0.03 + 0.07 * draw.spread(3), 0.04 + 0.22 * draw.spread(0))
    _, v = square(size)
    bend = noise(draw.rng, size, (2, 2), 3)
    beds = wave(v * (4, 7, 11)[int(3 * draw.spread(2))] + 0.35 * bend) + 0.5 * noise(draw.rng, size, (1, 24), 3)
    sand = noise(draw.rng, size, (120, 120), 2, 0.9)
    weight = 0.5 + draw.between(0.08, 0.2) * beds + 0.11 * sand
    return ramp(weight, (shaded(base, 0.72), base, shaded(base, 1.12)))


def slate(draw: Draw, size: int) -> Raster:
    """Split stone: steps, fine ridges, a dull sheen."""
    base = oklch(0.24 + 0.3 * draw.spread(1), 0.045 * draw.spread(3), draw.spread(0))
    coarse = (2, 3, 5)[int(3 * draw.spread(2))]
    height = noise(draw.rng, size, (coarse, 2 * coarse), 6, 0.62)
    steps = height + 0.25 * np.floor(1.5 * height)
    rust = smooth(noise(draw.rng, size, (3, 3), 4), 0.9, 2.2) * (0.5 if draw.chance(0.4) else 0.0)
    raster = ramp(0.5 + 0.16 * height, (shaded(base, 0.8), base, shaded(base, 1.25)))
    return lit(painted(raster, rgb("8a5f3c"), rust), relief(steps, draw.between(0.5, 1.1)))


def concrete(draw: Draw, size: int) -> Raster:
    """Cast or trowelled: clouds, stains, small pores."""
    base = oklch(0.38 + 0.5 * draw.spread(1), 0.024 * draw.spread(3), draw.spread(0))
    trowel = (1, 2, 4)[int(3 * draw.spread(2))]
    clouds = noise(draw.rng, size, (3, 3 * trowel), 6, 0.6)
    grit = noise(draw.rng, size, (100, 100), 2, 0.9)
    raster = ramp(0.5 + draw.between(0.1, 0.24) * clouds + 0.05 * grit, (shaded(base, 0.7), base, shaded(base, 1.2)))
    pores = smooth(noise(draw.rng, size, (56, 56), 2), draw.between(2.2, 2.8), 3.1)
    lines = _cracks(draw, size) if draw.chance(0.3) else np.zeros((size, size), dtype=np.float32)
    return lit(raster, relief(-pores, 0.4) - 0.35 * pores - 0.4 * lines)


def _cracks(draw: Draw, size: int) -> Field:
    path = noise(draw.rng, size, (2, 2), 6, 0.6)
    thin: Field = bell(path, 0.008) * smooth(noise(draw.rng, size, (2, 2), 2), 0.0, 0.8)
    return thin


def _colors(draw: Draw, palettes: Sequence[tuple[str, ...]]) -> list[Color]:
    tint = 0.88 + 0.22 * draw.spread(1)
    return [draw.near(shaded(rgb(c), tint), 10) for c in palettes[int(len(palettes) * draw.spread(0))]]
