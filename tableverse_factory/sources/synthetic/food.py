"""Fruit: apple, orange, lemon, pear, banana."""

import numpy as np

from tableverse_factory.sources.synthetic.colors import Color, described, pick_color
from tableverse_factory.sources.synthetic.model import Model, Texture
from tableverse_factory.sources.synthetic.solids import Profile, Rings, Solid, loft, revolved, tube
from tableverse_factory.sources.synthetic.textures import Raster, around_z, bands, blend, noise, plain, speckled

_STEM = np.array([92.0, 66.0, 42.0])


def apple(rng: np.random.Generator) -> Model:
    """An apple with its two dimples and a stem that stays within its hull."""
    radius = rng.uniform(0.034, 0.041)
    height = radius * rng.uniform(1.65, 1.85)
    profile = _rounded(radius, height, 0.8)
    dimple = np.exp(-((profile[:, 0] / (0.35 * radius)) ** 2))
    profile[:, 1] += np.where(profile[:, 1] < height / 2, 0.05, -0.16) * height * dimple
    profile[:, 1] -= profile[:, 1].min()
    stem = revolved(np.array([[0.0014, profile[-1, 1] - 0.004], [0.0018, profile[:, 1].max()]]))
    name, skin = pick_color(rng, ("red", "red", "green", "yellow"))
    _, blush = pick_color(rng, ("red", "yellow", "olive"))
    weight = noise(rng, (160, 120), (5, 3), 3)
    body = revolved(profile)
    mesh = (body + stem).mesh()
    fruit = around_z(_freckled(rng, skin, blush, 0.6 * weight**1.5), 0.0, height)
    stem_radius = 0.0021
    return Model(
        "apple", described(name, "apple"), mesh, (mesh.vertices,), _cored(fruit, stem_radius), _mass(body, 850.0), 0.15
    )


def orange(rng: np.random.Generator) -> Model:
    """An orange, slightly flattened."""
    radius = rng.uniform(0.033, 0.042)
    profile = _rounded(radius, radius * rng.uniform(1.84, 1.98), 1.0)
    body = revolved(profile)
    color = np.array([228.0, 126.0, 36.0]) + rng.normal(0.0, 6.0, 3)
    skin = speckled(rng, (240, 140), color, 0.82 * color)
    return Model(
        "orange",
        "an orange",
        body.mesh(),
        (body.mesh().vertices,),
        around_z(skin, 0.0, profile[-1, 1]),
        _mass(body, 900.0),
    )


def lemon(rng: np.random.Generator) -> Model:
    """A lemon or a lime that lies on its side."""
    radius, length = rng.uniform(0.024, 0.03), rng.uniform(0.068, 0.086)
    profile = _rounded(radius, length, 1.15)
    name, color = pick_color(rng, ("yellow", "yellow", "green"))
    label = "lime" if name == "green" else "lemon"
    standing = revolved(profile)
    body = standing.rotated((0.0, 90.0, 0.0)).moved((-length / 2, 0.0, radius))
    skin = speckled(rng, (200, 120), color, 0.85 * color)
    texture = around_z(skin, -0.5 * radius, 2 * radius)
    return Model(label, described(name, label), body.mesh(), (body.mesh().vertices,), texture, _mass(body, 900.0))


def pear(rng: np.random.Generator) -> Model:
    """A pear that stands."""
    radius, height = rng.uniform(0.031, 0.036), rng.uniform(0.08, 0.1)
    t = np.linspace(0.0, 1.0, 13)
    belly = np.sqrt(np.clip(1.0 - ((t - 0.34) / 0.36) ** 2, 0.0, 1.0)) * radius
    neck = np.sqrt(np.clip(1.0 - ((t - 0.6) / 0.4) ** 2, 0.0, 1.0)) * 0.52 * radius
    profile = np.column_stack([np.maximum(np.maximum(belly, neck), 0.2 * radius), t * height])
    name, skin = pick_color(rng, ("green", "yellow", "olive"))
    _, blush = pick_color(rng, ("red", "brown", "yellow"))
    body = revolved(profile)
    raster = _freckled(rng, skin, blush, 0.5 * noise(rng, (160, 120), (4, 3), 3) ** 2)
    return Model(
        "pear", described(name, "pear"), body.mesh(), body.pieces, around_z(raster, 0.0, height), _mass(body, 900.0)
    )


def banana(rng: np.random.Generator) -> Model:
    """A banana that lies flat, bent in the plane of the table."""
    bend, arc = rng.uniform(0.085, 0.11), rng.uniform(1.5, 1.9)
    radius = rng.uniform(0.0165, 0.0195)
    t = np.linspace(-0.5, 0.5, 13)
    width = radius * np.interp(
        t, [-0.5, -0.42, -0.28, 0.0, 0.28, 0.4, 0.45, 0.5], [0.35, 0.6, 0.92, 1.0, 0.9, 0.5, 0.3, 0.32]
    )
    center = np.column_stack(
        [bend * np.sin(arc * t), bend * (np.cos(arc * t) - np.cos(arc / 4)), np.full_like(t, radius)]
    )
    rings: Rings = tube(center, np.column_stack([width, width]), (0.0, 0.0, 1.0), around=10)
    body = loft(rings, stride=2)
    low, high = (float(x) for x in (rings[..., 0].min(), rings[..., 0].max()))
    color = np.array([230.0, 196.0, 62.0]) + rng.normal(0.0, 5.0, 3)
    ripe = noise(rng, (200, 60), (14, 6), 3)
    skin = blend(color, np.array([112.0, 78.0, 40.0]), np.clip(6.0 * (ripe - 0.82), 0.0, 0.8))
    tip = plain(np.array([88.0, 72.0, 40.0]))
    texture = bands((low + 0.006, high - 0.008), (tip, around_z(skin, 0.0, 2 * radius), tip), axis=0)
    return Model("banana", "a yellow banana", body.mesh(), body.pieces, texture, _mass(body, 950.0))


def _rounded(radius: float, height: float, sharpness: float) -> Profile:
    """An egg-like profile; a sharpness above 1 gives pointed ends, below 1 square shoulders."""
    t = np.linspace(-np.pi / 2, np.pi / 2, 15)
    profile: Profile = np.column_stack(
        [np.maximum(radius * np.cos(t) ** sharpness, 5e-4), height / 2 * (1 + np.sin(t))]
    )
    return profile


def _freckled(rng: np.random.Generator, skin: Color, blush: Color, weight: np.ndarray) -> Raster:
    raster = blend(skin, blush, weight)
    freckles = rng.random(weight.shape) < 0.01
    raster[freckles] = 0.5 * raster[freckles] + 0.5 * np.array([232.0, 222.0, 170.0])
    return raster


def _cored(fruit: Texture, stem_radius: float) -> Texture:
    def color(points: np.ndarray) -> np.ndarray:
        core = np.hypot(points[:, 0], points[:, 1]) < stem_radius
        return np.where(core[:, None], _STEM, fruit(points))

    return color


def _mass(body: Solid, density: float) -> float:
    return float(body.manifold.volume()) * density
