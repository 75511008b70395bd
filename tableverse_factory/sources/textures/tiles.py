"""Tiles: glazed squares, slabs of stone, mosaic."""

import numpy as np

from tableverse_factory.sources.textures.boards import lay_rows
from tableverse_factory.sources.textures.draw import TextureSampler, map_shades, oklch, parse_hex
from tableverse_factory.sources.textures.fields import (
    Color,
    Field,
    Raster,
    bell,
    brighten,
    shade_relief,
    smoothstep,
)


def draw_glazed_tiles(draw: TextureSampler) -> Raster:
    """Draw squares, each fired a little differently."""
    count = draw.choose((4, 6, 8, 10, 12))
    boards, base = lay_rows(draw.size, count, count, np.zeros(count)), _draw_glaze_color(draw)
    tone = draw.each(boards.count, draw.pick((0.02, 0.06, 0.14)))[boards.ids]
    pooled = draw.noise((16, 16), 4, 0.6)
    raster = map_shades(0.5 + draw.between(0.03, 0.2) * pooled, base, 0.78, 1.14)
    width, grout = draw.pick((0.002, 0.003, 0.005)), _draw_grout_color(draw)
    return _draw_joints(draw, brighten(raster, tone), boards.edge, width, grout)


def draw_stone_slabs(draw: TextureSampler) -> Raster:
    """Draw large squares of stone, clouds running on from none to the next."""
    count = draw.choose((2, 3, 4))
    boards = lay_rows(draw.size, count, count, np.zeros(count))
    base = draw.color((0.35, 0.55), (0.0, 0.05))
    clouds = draw.noise((6, 6), 6, 0.6)
    tone = draw.each(boards.count, 0.06)[boards.ids]
    raster = map_shades(0.5 + 0.2 * clouds, base, 0.75, 1.15)
    return _draw_joints(draw, brighten(raster, tone), boards.edge, 0.004, _draw_grout_color(draw))


def draw_mosaic(draw: TextureSampler) -> Raster:
    """Draw small squares of a few colours at random."""
    count = draw.choose((16, 20, 26, 32))
    boards = lay_rows(draw.size, count, count, np.zeros(count))
    hue, chroma, bright = draw.spread(0), 0.02 + 0.13 * draw.spread(3), 0.25 + 0.55 * draw.spread(1)
    palette = [
        oklch(min(0.96, max(0.12, bright + draw.between(-0.15, 0.2))), chroma * draw.between(0.4, 1.3), hue + turn)
        for turn in (-0.06, -0.02, 0.02, 0.07, draw.between(0.2, 0.8))
    ]
    kinds = draw.rng.integers(0, len(palette), boards.count)
    colors = np.asarray(palette, dtype=np.float32)[kinds] * (1 + draw.each(boards.count, 0.08))[:, None]
    return _draw_joints(draw, colors[boards.ids], boards.edge, 0.0022, _draw_grout_color(draw))


def _draw_glaze_color(draw: TextureSampler) -> Color:
    return oklch(0.3 + 0.66 * draw.spread(1), 0.13 * draw.spread(3), draw.spread(0))


def _draw_grout_color(draw: TextureSampler) -> Color:
    return draw.near(parse_hex(draw.pick(("e8e4dc", "c9c4ba", "8f8a82", "4a4744", "f3f1ec"))), 8)


def _draw_joints(draw: TextureSampler, raster: Raster, edge: Field, width: float, grout: Color) -> Raster:
    """Draw sandy joints as wide as twice `width`, and light on the tiles' rounded edges."""
    soft = max(0.4 * width, 0.5 / draw.size)
    inside = smoothstep(edge, width - soft, width + soft)
    body = brighten(raster, shade_relief(smoothstep(edge, width, 3.5 * width), 0.12) + 0.012 * draw.noise((40, 40), 2))
    sand = brighten(np.broadcast_to(grout, raster.shape), 0.05 * draw.noise((120, 120), 1))
    shade = -0.18 * bell(edge - np.float32(width), width)
    mixed: Raster = sand + (body - sand) * inside[..., None]
    return brighten(mixed, shade)
