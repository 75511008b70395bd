"""Tiles: squares, bricks, hexagons, mosaic, checkers, patterned cement, pennies."""

from collections.abc import Callable, Sequence

import numpy as np

from tableverse_factory.sources.textures.boards import lay_rows
from tableverse_factory.sources.textures.draw import TextureSampler, map_shades, oklch, parse_hex, scale_color
from tableverse_factory.sources.textures.fields import (
    Color,
    Field,
    Raster,
    bell,
    brighten,
    paint,
    pixel_grid,
    shade_relief,
    smoothstep,
    take_fraction,
)


def draw_glazed_tiles(draw: TextureSampler, layouts: Sequence[tuple[int, int]], steps: Sequence[float] = ()) -> Raster:
    """Draw squares, or bricks in a running bond, each fired a little differently.

    Layouts are numbers of tiles downwards and to the right, `steps` shifts of a row against the one above [tiles].
    """
    down, right = draw.choose(layouts)
    step = draw.pick(steps) if steps else 0.0
    boards, base = lay_rows(draw.size, down, right, np.arange(down) * step % 1), _draw_glaze_color(draw)
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


def draw_broken_mosaic(draw: TextureSampler) -> Raster:
    """Draw shards with wide joints."""
    count = draw.choose((9, 13, 18))
    shards = draw.cells(count, count)
    hue = draw.spread(0)
    palette = [oklch(draw.between(0.3, 0.95), draw.between(0.0, 0.16), hue + draw.between(-0.3, 0.3)) for _ in range(6)]
    palette[0] = oklch(0.2 + 0.75 * draw.spread(1), 0.16 * draw.spread(3), hue)
    kinds = np.minimum(draw.rng.integers(-3, len(palette), shards.count).clip(0), len(palette) - 1)
    colors = np.asarray(palette, dtype=np.float32)[kinds] * (1 + draw.each(shards.count, 0.1))[:, None]
    return _draw_joints(draw, colors[shards.ids], shards.border / (2 * count), 0.003, _draw_grout_color(draw))


def draw_hexagons(draw: TextureSampler) -> Raster:
    """Draw hexagons, or pennies: the cells of a triangular grid."""
    across, down = draw.choose(((7, 8), (12, 14), (19, 22)))
    u, v = pixel_grid(draw.size)
    x, y = u * across, v * down
    distance, second, ids = _find_hexagons(x, y, across, down)
    pennies = draw.chance(0.3)
    edge = (0.47 - distance) / across if pennies else (second - distance) / (2 * across)
    base, other = _draw_glaze_color(draw), _draw_glaze_color(draw, 1)
    accent = draw.rng.random(across * down) < draw.pick((0.0, 0.0, 0.2, 0.5))
    colors = np.where(accent[:, None], other, base) * (1 + draw.each(across * down, 0.09))[:, None]
    return _draw_joints(draw, colors.astype(np.float32)[ids], edge, 0.0028, _draw_grout_color(draw))


def draw_checkers(draw: TextureSampler) -> Raster:
    """Draw two colours by turns, of stone or linoleum."""
    count = draw.choose((4, 6, 8, 12, 16))
    boards = lay_rows(draw.size, count, count, np.zeros(count))
    light = draw.color((0.75, 0.22), (0.0, 0.07))
    dark = oklch(0.16 + 0.42 * draw.spread(4), 0.14 * draw.spread(3), draw.spread(0) + draw.pick((0.0, 0.5)))
    odd = (boards.ids // count + boards.ids) % 2 == 1
    raster = np.where(odd[..., None], dark, light).astype(np.float32)
    clouds = draw.noise((5, 5), 6, 0.6)
    width, grout = draw.pick((0.0008, 0.0025)), _draw_grout_color(draw)
    return _draw_joints(draw, brighten(raster, 0.06 * clouds), boards.edge, width, grout)


def draw_cement_tiles(draw: TextureSampler) -> Raster:
    """Draw patterned cement: each tile the mirror of the next, a star of arcs and petals in two or three colours."""
    count = draw.choose((4, 6, 8))
    u, v = pixel_grid(draw.size)
    x, y = (2 * np.abs(take_fraction(t * (count // 2)) - np.float32(0.5)) for t in (u, v))
    ground = oklch(0.82 + 0.15 * draw.spread(1), 0.05 * draw.spread(3), draw.spread(0) + 0.1)
    color = oklch(0.28 + 0.35 * draw.spread(4), 0.04 + 0.12 * draw.spread(3), draw.spread(0))
    third = oklch(draw.between(0.45, 0.8), draw.between(0.04, 0.14), draw.between(0, 1))
    raster = draw.fill(ground)
    for coat in (color, third, color)[: draw.whole(2, 3)]:
        raster = paint(raster, coat, 0.93 * smoothstep(_draw_motif(draw, x, y), -0.012, 0.012))
    boards = lay_rows(draw.size, count, count, np.zeros(count))
    chalky = 0.04 * draw.noise((20, 20), 4, 0.7)
    return _draw_joints(draw, brighten(raster, chalky), boards.edge, 0.0009, scale_color(ground, 0.7))


def _draw_motif(draw: TextureSampler, x: Field, y: Field) -> Field:
    """Draw a shape, positive inside, that is symmetric in x and y."""
    shapes: tuple[Callable[[], Field], ...] = (
        lambda: draw.between(0.3, 0.9) - np.sqrt(x * x + y * y),
        lambda: draw.between(0.04, 0.12) - np.abs(np.sqrt(x * x + y * y) - np.float32(draw.between(0.4, 0.95))),
        lambda: draw.between(0.4, 0.9) - (x + y),
        lambda: draw.between(0.03, 0.12) - np.abs(x + y - np.float32(draw.between(0.5, 1.3))),
        lambda: draw.between(0.05, 0.2) - np.abs(x - y),
        lambda: draw.between(0.25, 0.6) - np.sqrt((1 - x) * (1 - x) + (1 - y) * (1 - y)),
        lambda: draw.between(0.02, 0.12) - x * y,
        lambda: np.minimum(draw.between(0.9, 1.3) - np.sqrt(x * x + (1 - y) * (1 - y)),
                           draw.between(0.9, 1.3) - np.sqrt(y * y + (1 - x) * (1 - x))) - np.float32(0.3),
        lambda: draw.between(0.3, 0.7) - np.maximum(x, y),
    )  # fmt: skip
    return draw.pick(shapes)()


def _find_hexagons(x: Field, y: Field, across: int, down: int) -> tuple[Field, Field, np.ndarray]:
    """Find distances to the nearest two points of a triangular grid, and the nearest one's number; `down` is even."""
    rise = np.float32(across / down)
    nearest = np.full(x.shape, 9.0, dtype=np.float32)
    second, ids = nearest.copy(), np.zeros(x.shape, dtype=np.int32)
    row = np.floor(y).astype(np.int32)
    for step in (-1, 0, 1):
        j = row + step
        shift = (j % 2).astype(np.float32) * np.float32(0.5)
        i = np.floor(x - shift).astype(np.int32)
        for side in (0, 1):
            a, b = x - (i + side) - shift, (y - j) * rise
            distance = np.sqrt(a * a + b * b).astype(np.float32)
            second = np.minimum(second, np.maximum(nearest, distance))
            ids = np.where(distance < nearest, (j % down) * across + (i + side) % across, ids)
            nearest = np.minimum(nearest, distance)
    return nearest, second, ids.astype(np.int32)


def _draw_glaze_color(draw: TextureSampler, shift: int = 0) -> Color:
    return oklch(0.3 + 0.66 * draw.spread(1 + 3 * shift), 0.13 * draw.spread(3), draw.spread(0) + 0.5 * shift)


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
