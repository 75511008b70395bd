"""Packages and blocks: boxes, carton, can, bottle, jar, book, puzzle cube, sponge, wooden block."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from tableverse_factory.sources.synthetic.colors import PRINT, Color, pick_color
from tableverse_factory.sources.synthetic.model import GeneratedObject, GeneratorTop, Texture, make_box_top, make_object
from tableverse_factory.sources.synthetic.solids import Solid, make_block, make_hull, revolve
from tableverse_factory.sources.synthetic.textures import (
    Raster,
    blend_colors,
    draw_label,
    draw_speckles,
    draw_wood,
    fill_color,
    make_lattice_noise,
    map_to_box,
    split_bands,
    wrap_around_z,
)

Choice = TypeVar("Choice")
Size = tuple[float, float, float]

_TIN = np.array([188.0, 190.0, 194.0])


def make_cereal_box(rng: np.random.Generator) -> GeneratedObject:
    """Make a tall flat carton of cereal or crackers."""
    size = (rng.uniform(0.13, 0.175), rng.uniform(0.045, 0.065), rng.uniform(0.18, 0.24))
    words = (("CRUNCH", "FLAKES"), ("OATS", "& HONEY"), ("CRACKERS", "salted"), ("MUESLI", "nuts"))
    return _make_carton(rng, "cereal box", size, words, 0.38)


def make_tea_box(rng: np.random.Generator) -> GeneratedObject:
    """Make a low carton of tea or biscuits."""
    size = (rng.uniform(0.11, 0.15), rng.uniform(0.065, 0.085), rng.uniform(0.055, 0.08))
    words = (("GREEN", "TEA"), ("EARL", "GREY"), ("MINT", "infusion"), ("CHAI",))
    return _make_carton(rng, "tea box", size, words, 0.16)


def make_game_box(rng: np.random.Generator) -> GeneratedObject:
    """Make a wide flat box that lies on its back, as of a puzzle."""
    size = (rng.uniform(0.17, 0.23), rng.uniform(0.13, 0.17), rng.uniform(0.035, 0.055))
    return _make_carton(rng, "puzzle box", size, (("PUZZLE", "500"), ("CHESS",), ("DOMINO",), ("MEMORY", "game")), 0.5)


def make_juice_carton(rng: np.random.Generator) -> GeneratedObject:
    """Make a square carton with a gabled top."""
    side, height = rng.uniform(0.056, 0.074), rng.uniform(0.14, 0.19)
    gable, half = height + 0.42 * side, side / 2
    square = [(x, y) for x in (-half, half) for y in (-half, half)]
    corners = [(x, y, z) for x, y in square for z in (0.0, height)]
    ridge = [(x, y, gable) for x in (-half, half) for y in (-0.002, 0.002)]
    name, background = pick_color(rng, PRINT)
    _, accent = pick_color(rng, PRINT)
    words = _choose(rng, (("JUICE", "apple"), ("MILK",), ("ORANGE", "juice"), ("OAT", "drink")))
    faces = [draw_label(rng, (128, 320), background, accent, words) for _ in range(2)]
    sides = (faces[0], faces[1], faces[0], faces[1], _fill_raster(background), _fill_raster(background))
    texture = split_bands((height,), (map_to_box(sides, (side, side, height)), fill_color(0.92 * background)))
    return make_object("juice carton", name, make_hull(np.array(corners + ridge)), texture, 900.0 * side**2 * height)


def make_can(rng: np.random.Generator) -> GeneratedObject:
    """Make a tin of soup, fish or soda, two rims and a printed label."""
    radius, height = _choose(rng, ((0.0335, 0.102), (0.033, 0.118), (0.0425, 0.04), (0.037, 0.082)))
    rim = 0.0022
    profile = np.array([[radius - rim, 0.0], [radius, rim], [radius, height - rim], [radius - rim, height]])
    name, background = pick_color(rng, PRINT)
    _, accent = pick_color(rng, PRINT)
    words = _choose(rng, (("TOMATO", "soup"), ("TUNA",), ("BEANS",), ("CORN", "sweet"), ("COLA",)))
    label = wrap_around_z(draw_label(rng, (420, 200), background, accent, words), 0.004, height - 0.004)
    texture = split_bands((0.004, height - 0.004), (fill_color(_TIN), label, fill_color(_TIN)))
    top = GeneratorTop(height, 0.6 * radius, 0.6 * radius)
    mass = 1050.0 * np.pi * radius**2 * height
    return make_object("can", name, revolve(profile), texture, mass, 0.3, top=top)


def make_bottle(rng: np.random.Generator) -> GeneratedObject:
    """Make a bottle of water, sauce or shampoo with a screw cap."""
    radius, height = rng.uniform(0.028, 0.037), rng.uniform(0.15, 0.215)
    neck, shoulder = rng.uniform(0.012, 0.015), height * rng.uniform(0.6, 0.75)
    cap = height - 0.022
    t = np.linspace(0.0, np.pi / 2, 5)
    slope = np.column_stack([neck + (radius - neck) * np.cos(t), shoulder + (cap - 0.006 - shoulder) * np.sin(t)])
    foot = [[radius - 0.004, 0.0], [radius, 0.004]]
    profile = np.vstack([foot, slope, [[neck, cap], [neck + 0.0025, cap], [neck + 0.0025, height]]])
    name, body_color = pick_color(rng, PRINT)
    _, accent = pick_color(rng, PRINT)
    _, lid = pick_color(rng, ("white", "red", "blue", "black", "green", "yellow"))
    low, high = 0.16 * shoulder, 0.92 * shoulder
    words = _choose(rng, (("KETCHUP",), ("WATER", "still"), ("SHAMPOO",), ("MUSTARD",), ("SYRUP",)))
    label = wrap_around_z(draw_label(rng, (420, 220), accent, body_color, words), low, high)
    plain = fill_color(body_color)
    texture = split_bands((low, high, cap - 1e-4), (plain, label, plain, fill_color(lid)))
    return make_object("bottle", name, revolve(profile), texture, 900.0 * np.pi * radius**2 * shoulder, 0.2)


def make_jar(rng: np.random.Generator) -> GeneratedObject:
    """Make a jar of jam or spices with its lid on."""
    radius, height = rng.uniform(0.027, 0.042), rng.uniform(0.065, 0.12)
    lid, neck = height - 0.016, radius * rng.uniform(0.8, 0.9)
    body_steps = [[radius - 0.004, 0.0], [radius, 0.005], [radius, lid - 0.014], [neck, lid - 0.003]]
    lid_steps = [[neck, lid], [neck + 0.002, lid], [neck + 0.002, height - 0.002], [neck, height]]
    profile = np.array([*body_steps, *lid_steps])
    name, content = pick_color(rng, ("red", "orange", "brown", "olive", "purple", "yellow"))
    _, accent = pick_color(rng, PRINT)
    _, cap = pick_color(rng, ("red", "white", "grey", "black", "yellow", "green"))
    low, high = 0.2 * lid, 0.75 * lid
    words = _choose(rng, (("JAM",), ("HONEY",), ("PESTO",), ("SPICE",)))
    label = wrap_around_z(draw_label(rng, (420, 160), np.array([238.0, 232.0, 214.0]), accent, words), low, high)
    texture = split_bands((low, high, lid - 1e-4), (fill_color(content), label, fill_color(content), fill_color(cap)))
    top = GeneratorTop(height, 0.6 * neck, 0.6 * neck)
    mass = 1300.0 * np.pi * radius**2 * height
    return make_object("jar", name, revolve(profile), texture, mass, 0.25, top=top)


def make_book(rng: np.random.Generator) -> GeneratedObject:
    """Make a hardcover that lies flat: two boards, a spine towards -x, pages set back."""
    size = (rng.uniform(0.12, 0.165), rng.uniform(0.17, 0.23), rng.uniform(0.016, 0.038))
    board, inset = 0.002, 0.003
    cover = make_block((size[0], size[1], board))
    pages = make_block((size[0] - inset, size[1] - 2 * inset, size[2] - board)).translate((-inset / 2, 0.0, board / 2))
    spine = make_block((board, size[1], size[2])).translate((-(size[0] - board) / 2, 0.0, 0.0))
    body = cover + pages + spine + cover.translate((0.0, 0.0, size[2] - board))
    name, background = pick_color(rng, PRINT)
    _, accent = pick_color(rng, PRINT)
    words = _choose(rng, (("THE SEA", "a novel"), ("ATLAS",), ("GARDEN", "year"), ("PHYSICS", "II"), ("POEMS",)))
    front = draw_label(rng, (220, 300), background, accent, words)
    pages_noise = make_lattice_noise(rng, (64, 64), (1, 32), 1)
    paper = blend_colors(np.array([232.0, 226.0, 208.0]), np.array([196.0, 188.0, 168.0]), pages_noise)
    side = _fill_raster(background)
    edges = map_to_box((paper, paper, paper, side, front, side), size)
    boards = map_to_box((side, side, side, side, front, side), size)
    texture = split_bands((board, size[2] - board), (boards, edges, boards))
    whole = Solid(body.manifold, (np.concatenate(body.pieces),))
    return make_object("book", name, whole, texture, 700.0 * float(np.prod(size)), top=make_box_top(size))


def make_puzzle_cube(rng: np.random.Generator) -> GeneratedObject:
    """Make a twisting puzzle of nine coloured fields a side."""
    side = 0.057
    colors = np.array([[180, 40, 40], [40, 90, 170], [60, 150, 80], [230, 200, 60], [235, 235, 230], [225, 120, 40]])
    fields = [np.kron(colors[rng.integers(6, size=(3, 3))], np.ones((20, 20, 1))) for _ in range(6)]
    for field in fields:
        field[::20], field[19::20], field[:, ::20], field[:, 19::20] = 28.0, 28.0, 28.0, 28.0
    size = (side, side, side)
    body, texture, top = make_block(size, 0.003), map_to_box(fields, size), make_box_top(size)
    return make_object("puzzle cube", "puzzle", body, texture, 0.09, top=top, noun="cube with coloured fields")


def make_sponge(rng: np.random.Generator) -> GeneratedObject:
    """Make a kitchen sponge with a scouring side."""
    size = (rng.uniform(0.09, 0.115), rng.uniform(0.06, 0.075), rng.uniform(0.025, 0.035))
    name, color = pick_color(rng, ("yellow", "pink", "light blue", "orange"))
    soft = map_to_box([draw_speckles(rng, (90, 60), color, 0.65 * color)] * 6, size)
    green = draw_speckles(rng, (90, 60), np.array([44.0, 96.0, 62.0]), np.array([24.0, 56.0, 36.0]))
    texture = split_bands((0.75 * size[2],), (soft, map_to_box([green] * 6, size)))
    return make_object("sponge", name, make_block(size, 0.006), texture, 0.02, noun="and green sponge")


def make_wooden_block(rng: np.random.Generator) -> GeneratedObject:
    """Make a toy brick of wood."""
    size = (rng.uniform(0.05, 0.1), rng.uniform(0.03, 0.05), rng.uniform(0.025, 0.05))
    name, tint = pick_color(rng, ("beige", "brown", "red", "blue", "green", "yellow"))
    texture = map_to_box([draw_wood(rng, (120, 60), tint, 0.72 * tint)] * 6, size)
    mass = 600.0 * float(np.prod(size))
    return make_object("wooden block", name, make_block(size), texture, mass, top=make_box_top(size))


def _make_carton(
    rng: np.random.Generator, label: str, size: Size, wordings: Sequence[Sequence[str]], mass: float
) -> GeneratedObject:
    name, background = pick_color(rng, PRINT)
    _, accent = pick_color(rng, PRINT)
    texture = _make_faces(rng, size, background, accent, _choose(rng, wordings))
    mass_kg = mass * rng.uniform(0.8, 1.2)
    return make_object(label, name, make_block(size), texture, mass_kg, top=make_box_top(size))


def _make_faces(
    rng: np.random.Generator, size: Size, background: Color, accent: Color, words: Sequence[str]
) -> Texture:
    def face(width: float, height: float) -> Raster:
        return draw_label(rng, (max(32, round(width * 1600)), max(32, round(height * 1600))), background, accent, words)

    x, y, z = size
    front, side, top = face(x, z), face(y, z), face(x, y)
    return map_to_box((front, side, front, side, top, _fill_raster(background)), size)


def _fill_raster(color: Color) -> Raster:
    return np.broadcast_to(color, (2, 2, 3))


def _choose(rng: np.random.Generator, options: Sequence[Choice]) -> Choice:
    return options[int(rng.integers(len(options)))]
