"""Fruit: apple, orange, lemon, pear, banana."""

import numpy as np

from tableverse_factory.sources.synthetic.colors import Color, pick_color
from tableverse_factory.sources.synthetic.model import GeneratedObject, Texture, make_object
from tableverse_factory.sources.synthetic.solids import Profile, Rings, Solid, make_loft, make_tube, revolve
from tableverse_factory.sources.synthetic.textures import (
    Raster,
    blend_colors,
    draw_speckles,
    fill_color,
    make_lattice_noise,
    split_bands,
    wrap_around_z,
)

_STEM = np.array([92.0, 66.0, 42.0])


def make_apple(rng: np.random.Generator) -> GeneratedObject:
    """Make an apple with its two dimples and a stem that stays within its hull."""
    radius = rng.uniform(0.034, 0.041)
    height = radius * rng.uniform(1.65, 1.85)
    profile = _make_egg_profile(radius, height, 0.8)
    dimple = np.exp(-((profile[:, 0] / (0.35 * radius)) ** 2))
    profile[:, 1] += np.where(profile[:, 1] < height / 2, 0.05, -0.16) * height * dimple
    profile[:, 1] -= profile[:, 1].min()
    stem = revolve(np.array([[0.0014, profile[-1, 1] - 0.004], [0.0018, profile[:, 1].max()]]))
    name, skin = pick_color(rng, ("red", "red", "green", "yellow"))
    _, blush = pick_color(rng, ("red", "yellow", "olive"))
    weight = make_lattice_noise(rng, (160, 120), (5, 3), 3)
    body = revolve(profile)
    fruit = wrap_around_z(_draw_freckles(rng, skin, blush, 0.6 * weight**1.5), 0.0, height)
    texture = _paint_stem(fruit, 0.0021)
    return make_object("apple", name, body + stem, texture, _compute_mass(body, 850.0), 0.15, convex=True)


def make_orange(rng: np.random.Generator) -> GeneratedObject:
    """Make an orange, slightly flattened."""
    radius = rng.uniform(0.033, 0.042)
    profile = _make_egg_profile(radius, radius * rng.uniform(1.84, 1.98), 1.0)
    body = revolve(profile)
    color = np.array([228.0, 126.0, 36.0]) + rng.normal(0.0, 6.0, 3)
    skin = draw_speckles(rng, (240, 140), color, 0.82 * color)
    mesh, texture = body.to_mesh(), wrap_around_z(skin, 0.0, profile[-1, 1])
    return GeneratedObject("orange", "an orange", mesh, (mesh.vertices,), texture, _compute_mass(body, 900.0))


def make_lemon(rng: np.random.Generator) -> GeneratedObject:
    """Make a lemon or a lime that lies on its side."""
    radius, length = rng.uniform(0.024, 0.03), rng.uniform(0.068, 0.086)
    profile = _make_egg_profile(radius, length, 1.15)
    name, color = pick_color(rng, ("yellow", "yellow", "green"))
    label = "lime" if name == "green" else "lemon"
    standing = revolve(profile)
    body = standing.rotate((0.0, 90.0, 0.0)).translate((-length / 2, 0.0, radius))
    skin = draw_speckles(rng, (200, 120), color, 0.85 * color)
    texture = wrap_around_z(skin, -0.5 * radius, 2 * radius)
    return make_object(label, name, body, texture, _compute_mass(body, 900.0), convex=True)


def make_pear(rng: np.random.Generator) -> GeneratedObject:
    """Make a pear that stands."""
    radius, height = rng.uniform(0.031, 0.036), rng.uniform(0.08, 0.1)
    t = np.linspace(0.0, 1.0, 13)
    belly = np.sqrt(np.clip(1.0 - ((t - 0.34) / 0.36) ** 2, 0.0, 1.0)) * radius
    neck = np.sqrt(np.clip(1.0 - ((t - 0.6) / 0.4) ** 2, 0.0, 1.0)) * 0.52 * radius
    profile = np.column_stack([np.maximum(np.maximum(belly, neck), 0.2 * radius), t * height])
    name, skin = pick_color(rng, ("green", "yellow", "olive"))
    _, blush = pick_color(rng, ("red", "brown", "yellow"))
    body = revolve(profile)
    raster = _draw_freckles(rng, skin, blush, 0.5 * make_lattice_noise(rng, (160, 120), (4, 3), 3) ** 2)
    return make_object("pear", name, body, wrap_around_z(raster, 0.0, height), _compute_mass(body, 900.0))


def make_banana(rng: np.random.Generator) -> GeneratedObject:
    """Make a banana that lies flat, bent in the plane of the table."""
    bend, arc = rng.uniform(0.085, 0.11), rng.uniform(1.5, 1.9)
    radius = rng.uniform(0.0165, 0.0195)
    t = np.linspace(-0.5, 0.5, 13)
    places = [-0.5, -0.42, -0.28, 0.0, 0.28, 0.4, 0.45, 0.5]
    width = radius * np.interp(t, places, [0.35, 0.6, 0.92, 1.0, 0.9, 0.5, 0.3, 0.32])
    x, y = bend * np.sin(arc * t), bend * (np.cos(arc * t) - np.cos(arc / 4))
    center = np.column_stack([x, y, np.full_like(t, radius)])
    rings: Rings = make_tube(center, np.column_stack([width, width]), (0.0, 0.0, 1.0), around=10)
    body = make_loft(rings, stride=2)
    low, high = (float(x) for x in (rings[..., 0].min(), rings[..., 0].max()))
    color = np.array([230.0, 196.0, 62.0]) + rng.normal(0.0, 5.0, 3)
    ripe = make_lattice_noise(rng, (200, 60), (14, 6), 3)
    skin = blend_colors(color, np.array([112.0, 78.0, 40.0]), np.clip(6.0 * (ripe - 0.82), 0.0, 0.8))
    tip = fill_color(np.array([88.0, 72.0, 40.0]))
    texture = split_bands((low + 0.006, high - 0.008), (tip, wrap_around_z(skin, 0.0, 2 * radius), tip), axis=0)
    return make_object("banana", "yellow", body, texture, _compute_mass(body, 950.0))


def _make_egg_profile(radius: float, height: float, sharpness: float) -> Profile:
    """Make an egg-like profile; a sharpness above 1 gives pointed ends, below 1 square shoulders."""
    t = np.linspace(-np.pi / 2, np.pi / 2, 15)
    return np.column_stack([np.maximum(radius * np.cos(t) ** sharpness, 5e-4), height / 2 * (1 + np.sin(t))])


def _draw_freckles(rng: np.random.Generator, skin: Color, blush: Color, weight: np.ndarray) -> Raster:
    raster = blend_colors(skin, blush, weight)
    freckles = rng.random(weight.shape) < 0.01
    raster[freckles] = 0.5 * raster[freckles] + 0.5 * np.array([232.0, 222.0, 170.0])
    return raster


def _paint_stem(fruit: Texture, stem_radius: float) -> Texture:
    def color(points: np.ndarray) -> np.ndarray:
        core = np.hypot(points[:, 0], points[:, 1]) < stem_radius
        return np.where(core[:, None], _STEM, fruit(points))

    return color


def _compute_mass(body: Solid, density: float) -> float:
    return float(body.manifold.volume()) * density
