"""What comes from a shop: boxes, carton, can, bottle, jar, book, and a few small blocks."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from tableverse_factory.sources.synthetic.colors import PRINT, Color, described, pick_color
from tableverse_factory.sources.synthetic.model import GeneratorTop, Model, Texture
from tableverse_factory.sources.synthetic.solids import block, hull, revolved
from tableverse_factory.sources.synthetic.textures import (
    Raster,
    around_z,
    bands,
    blend,
    noise,
    on_box,
    plain,
    printed,
    speckled,
    wood,
)

Choice = TypeVar("Choice")

_TIN = np.array([188.0, 190.0, 194.0])


def cereal_box(rng: np.random.Generator) -> Model:
    """A tall flat carton of cereal or crackers."""
    size = (rng.uniform(0.13, 0.175), rng.uniform(0.045, 0.065), rng.uniform(0.18, 0.24))
    words = (("CRUNCH", "FLAKES"), ("OATS", "& HONEY"), ("CRACKERS", "salted"), ("MUESLI", "nuts"))
    return _carton(rng, "cereal box", size, words, 0.38)


def tea_box(rng: np.random.Generator) -> Model:
    """A low carton of tea or biscuits."""
    size = (rng.uniform(0.11, 0.15), rng.uniform(0.065, 0.085), rng.uniform(0.055, 0.08))
    return _carton(rng, "tea box", size, (("GREEN", "TEA"), ("EARL", "GREY"), ("MINT", "infusion"), ("CHAI",)), 0.16)


def game_box(rng: np.random.Generator) -> Model:
    """A wide flat box that lies on its back, as of a puzzle."""
    size = (rng.uniform(0.17, 0.23), rng.uniform(0.13, 0.17), rng.uniform(0.035, 0.055))
    return _carton(rng, "puzzle box", size, (("PUZZLE", "500"), ("CHESS",), ("DOMINO",), ("MEMORY", "game")), 0.5)


def juice_carton(rng: np.random.Generator) -> Model:
    """A square carton with a gabled top."""
    side, height = rng.uniform(0.056, 0.074), rng.uniform(0.14, 0.19)
    gable, half = height + 0.42 * side, side / 2
    square = [(x, y) for x in (-half, half) for y in (-half, half)]
    corners = [(x, y, z) for x, y in square for z in (0.0, height)]
    ridge = [(x, y, gable) for x in (-half, half) for y in (-0.002, 0.002)]
    name, background = pick_color(rng, PRINT)
    _, accent = pick_color(rng, PRINT)
    words: tuple[str, ...] = _choice(rng, (("JUICE", "apple"), ("MILK",), ("ORANGE", "juice"), ("OAT", "drink")))
    faces = [printed(rng, (128, 320), background, accent, words) for _ in range(2)]
    sides = (faces[0], faces[1], faces[0], faces[1], _flat(background), _flat(background))
    texture = bands((height,), (on_box(sides, (side, side, height)), plain(0.92 * background)))
    body = hull(np.array(corners + ridge))
    return Model(
        "juice carton", described(name, "juice carton"), body.mesh(), body.pieces, texture, 900.0 * side**2 * height
    )


def can(rng: np.random.Generator) -> Model:
    """A tin of soup, fish or soda, two rims and a printed label."""
    radius, height = _choice(rng, ((0.0335, 0.102), (0.033, 0.118), (0.0425, 0.04), (0.037, 0.082)))
    rim = 0.0022
    profile = np.array([[radius - rim, 0.0], [radius, rim], [radius, height - rim], [radius - rim, height]])
    name, background = pick_color(rng, PRINT)
    _, accent = pick_color(rng, PRINT)
    words: tuple[str, ...] = _choice(rng, (("TOMATO", "soup"), ("TUNA",), ("BEANS",), ("CORN", "sweet"), ("COLA",)))
    label = around_z(printed(rng, (420, 200), background, accent, words), 0.004, height - 0.004)
    texture = bands((0.004, height - 0.004), (plain(_TIN), label, plain(_TIN)))
    top = GeneratorTop(height, 0.6 * radius, 0.6 * radius)
    body = revolved(profile)
    mass = 1050.0 * np.pi * radius**2 * height
    return Model("can", described(name, "can"), body.mesh(), body.pieces, texture, mass, 0.3, top=top)


def bottle(rng: np.random.Generator) -> Model:
    """A bottle of water, sauce or shampoo with a screw cap."""
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
    words: tuple[str, ...] = _choice(rng, (("KETCHUP",), ("WATER", "still"), ("SHAMPOO",), ("MUSTARD",), ("SYRUP",)))
    label = around_z(printed(rng, (420, 220), accent, body_color, words), low, high)
    texture = bands((low, high, cap - 1e-4), (plain(body_color), label, plain(body_color), plain(lid)))
    body = revolved(profile)
    mass = 900.0 * np.pi * radius**2 * shoulder
    return Model("bottle", described(name, "bottle"), body.mesh(), body.pieces, texture, mass, 0.2)


def jar(rng: np.random.Generator) -> Model:
    """A jar of jam or spices with its lid on."""
    radius, height = rng.uniform(0.027, 0.042), rng.uniform(0.065, 0.12)
    lid, neck = height - 0.016, radius * rng.uniform(0.8, 0.9)
    body_steps = [[radius - 0.004, 0.0], [radius, 0.005], [radius, lid - 0.014], [neck, lid - 0.003]]
    lid_steps = [[neck, lid], [neck + 0.002, lid], [neck + 0.002, height - 0.002], [neck, height]]
    profile = np.array([*body_steps, *lid_steps])
    name, content = pick_color(rng, ("red", "orange", "brown", "olive", "purple", "yellow"))
    _, accent = pick_color(rng, PRINT)
    _, cap = pick_color(rng, ("red", "white", "grey", "black", "yellow", "green"))
    low, high = 0.2 * lid, 0.75 * lid
    words: tuple[str, ...] = _choice(rng, (("JAM",), ("HONEY",), ("PESTO",), ("SPICE",)))
    label = around_z(printed(rng, (420, 160), np.array([238.0, 232.0, 214.0]), accent, words), low, high)
    texture = bands((low, high, lid - 1e-4), (plain(content), label, plain(content), plain(cap)))
    top = GeneratorTop(height, 0.6 * neck, 0.6 * neck)
    body = revolved(profile)
    mass = 1300.0 * np.pi * radius**2 * height
    return Model("jar", described(name, "jar"), body.mesh(), body.pieces, texture, mass, 0.25, top=top)


def book(rng: np.random.Generator) -> Model:
    """A hardcover that lies flat: two boards, a spine towards -x, pages set back."""
    size = (rng.uniform(0.12, 0.165), rng.uniform(0.17, 0.23), rng.uniform(0.016, 0.038))
    board, inset = 0.002, 0.003
    cover = block((size[0], size[1], board))
    pages = block((size[0] - inset, size[1] - 2 * inset, size[2] - board)).moved((-inset / 2, 0.0, board / 2))
    spine = block((board, size[1], size[2])).moved((-(size[0] - board) / 2, 0.0, 0.0))
    body = cover + pages + spine + cover.moved((0.0, 0.0, size[2] - board))
    name, background = pick_color(rng, PRINT)
    _, accent = pick_color(rng, PRINT)
    words: tuple[str, ...] = _choice(
        rng, (("THE SEA", "a novel"), ("ATLAS",), ("GARDEN", "year"), ("PHYSICS", "II"), ("POEMS",))
    )
    front = printed(rng, (220, 300), background, accent, words)
    paper = blend(np.array([232.0, 226.0, 208.0]), np.array([196.0, 188.0, 168.0]), noise(rng, (64, 64), (1, 32), 1))
    side = _flat(background)
    edges = on_box((paper, paper, paper, side, front, side), size)
    boards = on_box((side, side, side, side, front, side), size)
    texture = bands((board, size[2] - board), (boards, edges, boards))
    top = GeneratorTop(size[2], size[0] / 2, size[1] / 2)
    mass = 700.0 * float(np.prod(size))
    return Model("book", described(name, "book"), body.mesh(), (np.concatenate(body.pieces),), texture, mass, top=top)


def puzzle_cube(rng: np.random.Generator) -> Model:
    """A twisting puzzle of nine coloured fields a side."""
    side = 0.057
    colors = np.array([[180, 40, 40], [40, 90, 170], [60, 150, 80], [230, 200, 60], [235, 235, 230], [225, 120, 40]])
    fields = [np.kron(colors[rng.integers(6, size=(3, 3))], np.ones((20, 20, 1))) for _ in range(6)]
    for field in fields:
        field[::20], field[19::20], field[:, ::20], field[:, 19::20] = 28.0, 28.0, 28.0, 28.0
    body = block((side, side, side), 0.003)
    top = GeneratorTop(side, side / 2, side / 2)
    texture = on_box(fields, (side, side, side))
    return Model("puzzle cube", "a puzzle cube with coloured fields", body.mesh(), body.pieces, texture, 0.09, top=top)


def sponge(rng: np.random.Generator) -> Model:
    """A kitchen sponge with a scouring side."""
    size = (rng.uniform(0.09, 0.115), rng.uniform(0.06, 0.075), rng.uniform(0.025, 0.035))
    name, color = pick_color(rng, ("yellow", "pink", "light blue", "orange"))
    soft = on_box([speckled(rng, (90, 60), color, 0.65 * color)] * 6, size)
    scourer = on_box([speckled(rng, (90, 60), np.array([44.0, 96.0, 62.0]), np.array([24.0, 56.0, 36.0]))] * 6, size)
    body = block(size, 0.006)
    texture = bands((0.75 * size[2],), (soft, scourer))
    return Model("sponge", described(name, "and green sponge"), body.mesh(), body.pieces, texture, 0.02)


def wooden_block(rng: np.random.Generator) -> Model:
    """A toy brick of wood."""
    size = (rng.uniform(0.05, 0.1), rng.uniform(0.03, 0.05), rng.uniform(0.025, 0.05))
    name, tint = pick_color(rng, ("beige", "brown", "red", "blue", "green", "yellow"))
    body = block(size)
    texture = on_box([wood(rng, (120, 60), tint, 0.72 * tint)] * 6, size)
    top = GeneratorTop(size[2], size[0] / 2, size[1] / 2)
    mass = 600.0 * float(np.prod(size))
    return Model("wooden block", described(name, "wooden block"), body.mesh(), body.pieces, texture, mass, top=top)


def _carton(
    rng: np.random.Generator,
    label: str,
    size: tuple[float, float, float],
    wordings: Sequence[Sequence[str]],
    mass: float,
) -> Model:
    name, background = pick_color(rng, PRINT)
    _, accent = pick_color(rng, PRINT)
    words = _choice(rng, wordings)
    body = block(size)
    top = GeneratorTop(size[2], size[0] / 2, size[1] / 2)
    texture = _package_faces(rng, size, background, accent, words)
    return Model(
        label, described(name, label), body.mesh(), body.pieces, texture, mass * rng.uniform(0.8, 1.2), top=top
    )


def _package_faces(
    rng: np.random.Generator, size: tuple[float, float, float], background: Color, accent: Color, words: Sequence[str]
) -> Texture:
    def face(width: float, height: float) -> Raster:
        return printed(rng, (max(32, round(width * 1600)), max(32, round(height * 1600))), background, accent, words)

    x, y, z = size
    front, side, top = face(x, z), face(y, z), face(x, y)
    return on_box((front, side, front, side, top, _flat(background)), size)


def _flat(color: Color) -> Raster:
    return np.broadcast_to(color, (2, 2, 3))


def _choice(rng: np.random.Generator, options: Sequence[Choice]) -> Choice:
    return options[int(rng.integers(len(options)))]
