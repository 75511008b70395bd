"""Open vessels with true cavities: bowl, mug, cup, plate, pan."""

import numpy as np

from schemas.geometry import Points
from tableverse_factory.sources.synthetic.colors import CERAMIC, Color, pick_color
from tableverse_factory.sources.synthetic.model import (
    GeneratedObject,
    GeneratorCavity,
    GeneratorTop,
    Texture,
    make_object,
)
from tableverse_factory.sources.synthetic.solids import Profile, make_loft, make_shell, make_tube
from tableverse_factory.sources.synthetic.textures import (
    blend_colors,
    draw_speckles,
    fill_color,
    make_lattice_noise,
    split_bands,
    wrap_around_z,
)

WALL_M = 0.0035


def make_bowl(rng: np.random.Generator) -> GeneratedObject:
    """Make a round bowl for cereal or fruit."""
    radius, height = rng.uniform(0.062, 0.092), rng.uniform(0.046, 0.07)
    foot = radius * rng.uniform(0.45, 0.6)
    bulge = rng.uniform(0.7, 1.0)
    t = np.linspace(0.0, np.pi / 2, 5)
    outer = np.column_stack([foot + (radius - foot) * np.sin(t) ** bulge, height * (1.0 - np.cos(t))])
    inner = _make_inner_profile(outer, WALL_M, 0.005)
    name, color = pick_color(rng, CERAMIC)
    cavity = GeneratorCavity(inner[0, 1], height, inner[0, 0], inner[-1, 0])
    mass = rng.uniform(0.25, 0.45)
    return make_object("bowl", name, make_shell(outer, inner), _make_glaze(rng, outer, color), mass, 0.25, cavity)


def make_plate(rng: np.random.Generator) -> GeneratedObject:
    """Make a dinner plate or a saucer."""
    radius, height = rng.uniform(0.08, 0.125), rng.uniform(0.016, 0.024)
    foot = radius * rng.uniform(0.55, 0.68)
    outer = np.array([[foot, 0.0], [foot + 0.35 * (radius - foot), 0.35 * height], [radius, height]])
    inner = _make_inner_profile(outer, WALL_M, 0.004)
    name, color = pick_color(rng, CERAMIC)
    top = GeneratorTop(inner[0, 1], inner[0, 0] * 0.7, inner[0, 0] * 0.7)
    texture = _make_glaze(rng, outer, color)
    return make_object("plate", name, make_shell(outer, inner), texture, rng.uniform(0.3, 0.6), 0.25, top=top)


def make_cup(rng: np.random.Generator) -> GeneratedObject:
    """Make a tumbler without a handle."""
    radius, height = rng.uniform(0.034, 0.044), rng.uniform(0.08, 0.125)
    foot = radius * rng.uniform(0.72, 0.95)
    outer = np.array([[foot - 0.002, 0.0], [foot, 0.004], [radius, height]])
    inner = np.array([[foot - 0.006, 0.005], [foot - 0.003, 0.008], [radius - 0.003, height]])
    name, color = pick_color(rng, CERAMIC)
    cavity = GeneratorCavity(0.005, height, float(inner[0, 0]), float(inner[-1, 0]))
    texture = _make_glaze(rng, outer, color)
    return make_object("cup", name, make_shell(outer, inner), texture, rng.uniform(0.15, 0.3), 0.2, cavity)


def make_mug(rng: np.random.Generator) -> GeneratedObject:
    """Make a coffee mug, its handle towards +x."""
    radius, height = rng.uniform(0.038, 0.046), rng.uniform(0.085, 0.108)
    outer = np.array([[radius - 0.003, 0.0], [radius, 0.004], [radius, height]])
    inner = np.array([[radius - 0.007, 0.006], [radius - 0.004, 0.009], [radius - 0.004, height]])
    t = np.linspace(-np.pi / 2, np.pi / 2, 11)
    reach, rise = rng.uniform(0.026, 0.034), height * rng.uniform(0.26, 0.32)
    center = np.column_stack([radius - 0.002 + reach * np.cos(t), 0 * t, height * 0.52 + rise * np.sin(t)])
    handle = make_loft(make_tube(center, np.full((11, 2), [0.006, 0.0042]), (0.0, 1.0, 0.0)), stride=2)
    name, color = pick_color(rng, CERAMIC)
    cavity = GeneratorCavity(0.006, height, float(inner[0, 0]), float(inner[-1, 0]))
    body = make_shell(outer, inner) + handle
    texture = _make_glaze(rng, outer, color)
    return make_object("mug", name, body, texture, rng.uniform(0.28, 0.42), 0.25, cavity)


def make_pan(rng: np.random.Generator) -> GeneratedObject:
    """Make a frying pan, its handle towards +x."""
    radius, height, wall = rng.uniform(0.085, 0.11), rng.uniform(0.036, 0.048), 0.003
    foot = radius * rng.uniform(0.78, 0.88)
    outer = np.array([[foot, 0.0], [0.5 * (foot + radius), 0.45 * height], [radius, height]])
    inner = _make_inner_profile(outer, wall, 0.004)
    reach = rng.uniform(0.13, 0.16)
    t = np.linspace(0.0, 1.0, 6)
    center = np.column_stack([radius - 0.0025 + reach * t, 0 * t, 0.8 * height + 0.022 * np.sin(t * np.pi / 2)])
    handle = make_loft(make_tube(center, np.column_stack([0.008 + 0.004 * t, 0.0045 + 0.002 * t]), (0.0, 1.0, 0.0)))
    name, color = pick_color(rng, ("black", "grey", "red", "teal", "navy"))
    vessel = _make_two_sided(outer, fill_color(color), fill_color(np.array([52.0, 52.0, 56.0])))
    texture = split_bands((radius + 0.006,), (vessel, fill_color(np.array([38.0, 36.0, 36.0]))), axis=0)
    cavity = GeneratorCavity(float(inner[0, 1]), height, float(inner[0, 0]), float(inner[-1, 0]))
    body = make_shell(outer, inner) + handle
    return make_object("pan", name, body, texture, rng.uniform(0.6, 0.9), 0.35, cavity, noun="frying pan")


def _make_inner_profile(outer: Profile, wall: float, floor: float) -> Profile:
    height = outer[-1, 1]
    return np.column_stack([outer[:, 0] - wall, floor + (height - floor) * outer[:, 1] / height])


def _make_glaze(rng: np.random.Generator, outer: Profile, color: Color) -> Texture:
    """Make a ceramic glaze: plain, speckled, banded or dipped, often with another colour inside."""
    height = float(outer[-1, 1])
    _, second = pick_color(rng, CERAMIC)
    kind = int(rng.integers(4))
    if kind == 0:
        outside = fill_color(color)
    elif kind == 1:
        outside = wrap_around_z(draw_speckles(rng, (240, 120), color, 0.55 * color), 0.0, height)
    elif kind == 2:
        low = rng.uniform(0.35, 0.65) * height
        outside = split_bands((low, low + 0.2 * height), (fill_color(color), fill_color(second), fill_color(color)))
    else:
        edge = make_lattice_noise(rng, (240, 120), (8, 1), 2) * 0.2 + np.linspace(1.0, 0.0, 120)[:, None]
        dipped = (edge > rng.uniform(0.5, 0.8)).astype(np.float64)
        outside = wrap_around_z(blend_colors(color, second, dipped), 0.0, height)
    inside = color if rng.random() < 0.5 else np.array([240.0, 237.0, 228.0])
    return _make_two_sided(outer, outside, fill_color(inside))


def _make_two_sided(outer: Profile, outside: Texture, inside: Texture) -> Texture:
    """Use one texture outside and on whatever sticks out, another inside and on the rim."""

    def color(points: Points) -> Points:
        radius = np.hypot(points[:, 0], points[:, 1])
        limit = np.interp(points[:, 2], outer[:, 1], outer[:, 0]) - 0.3 * WALL_M
        within = (radius < limit) & (points[:, 2] > 1e-3)
        return np.where(within[:, None], inside(points), outside(points))

    return color
