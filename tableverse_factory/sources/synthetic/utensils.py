"""Flat and slender objects: spoon, fork, knife, pen, phone, remote control."""

import numpy as np

from tableverse_factory.sources.synthetic.colors import Color, pick_color
from tableverse_factory.sources.synthetic.model import GeneratedObject, Texture, make_object
from tableverse_factory.sources.synthetic.solids import (
    Solid,
    make_hull,
    make_loft,
    make_prism,
    make_shell,
    make_tube,
    revolve,
)
from tableverse_factory.sources.synthetic.textures import Raster, draw_wood, fill_color, project_along, split_bands

_STEEL = np.array([176.0, 180.0, 186.0])


def make_spoon(rng: np.random.Generator) -> GeneratedObject:
    """Make a spoon along x, its bowl towards +x, of steel, plastic or wood."""
    length, width, depth = rng.uniform(0.15, 0.19), rng.uniform(0.032, 0.042), rng.uniform(0.007, 0.01)
    reach, wall = 0.3 * length, 0.0022
    outer = np.array([[0.35, 0.0], [0.78, 0.38 * depth], [1.0, depth]])
    inner = np.array([[0.3, wall], [0.72, wall + 0.38 * (depth - wall)], [0.91, depth]])
    scoop = _stretch(make_shell(outer, inner), reach / 2, width / 2).translate((length / 2 - reach / 2, 0.0, 0.0))
    body = scoop + _make_handle(-length / 2, length / 2 - reach + 0.004, 0.85 * depth, rng.uniform(0.005, 0.007))
    return _make_cutlery(rng, "spoon", body)


def make_fork(rng: np.random.Generator) -> GeneratedObject:
    """Make a fork along x, its four tines towards +x."""
    length, width = rng.uniform(0.17, 0.195), rng.uniform(0.021, 0.026)
    neck, tip = 0.2 * length, 0.5 * length
    root = tip - 0.048
    palm = [[neck, y, z] for y in (-0.004, 0.004) for z in (0.0035, 0.0058)]
    palm += [[root, y * width, z] for y in (-0.5, 0.5) for z in (0.0, 0.0024)]
    body = make_hull(np.array(palm)) + _make_handle(-length / 2, neck + 0.003, 0.0046, rng.uniform(0.005, 0.0065))
    x = np.array([root - 0.002, root + 0.022, tip])
    radii = np.array([[0.0018, 0.0013], [0.0016, 0.0012], [0.0008, 0.0008]])
    for y in (np.arange(4) - 1.5) * (width - 0.0036) / 3:
        center = np.column_stack([x, np.full(3, y), [0.0013, 0.0028, 0.0068]])
        body += make_loft(make_tube(center, radii, (0.0, 1.0, 0.0), 6))
    return _make_cutlery(rng, "fork", body)


def make_knife(rng: np.random.Generator) -> GeneratedObject:
    """Make a table knife along x, its blade towards +x."""
    length, width = rng.uniform(0.19, 0.23), rng.uniform(0.018, 0.023)
    tip, neck = length / 2, -0.02
    outline = [(neck, -0.006), (neck, 0.006), (0.55 * tip, width / 2), (0.9 * tip, width / 2)]
    outline += [(tip, -0.002), (0.8 * tip, -width / 2)]
    blade = make_hull(np.array([(x, y, z) for x, y in outline for z in (0.0, 0.0022)]))
    body = blade + _make_handle(-tip, neck + 0.006, 0.0036, rng.uniform(0.006, 0.0085), arch=0.0)
    return _make_cutlery(rng, "knife", body, handle_end=neck + 0.004)


def make_pen(rng: np.random.Generator) -> GeneratedObject:
    """Make a ball pen or a thick marker along x; twelve-sided, so that it does not roll away."""
    thick = rng.random() < 0.4
    radius, length = (rng.uniform(0.007, 0.0095), 0.125) if thick else (rng.uniform(0.0042, 0.0052), 0.145)
    x = np.array([-0.5, -0.47, 0.36, 0.43, 0.5]) * length
    width = radius * np.array([0.8, 1.0, 1.0, 0.75, 0.25])
    center = np.column_stack([x, np.zeros(5), np.full(5, radius * np.cos(np.pi / 12))])
    body = make_loft(make_tube(center, np.column_stack([width, width]), (0.0, 1.0, 0.0)))
    name, color = pick_color(rng, ("blue", "black", "red", "green", "purple", "orange"))
    barrel = color if rng.random() < 0.5 else np.array([236.0, 236.0, 232.0])
    bands = (fill_color(color), fill_color(barrel), fill_color(0.6 * color))
    texture = split_bands((-0.1 * length, 0.37 * length), bands, axis=0)
    label = "marker" if thick else "pen"
    return make_object(label, name, body, texture, 0.02 if thick else 0.012, 0.1, convex=True)


def make_phone(rng: np.random.Generator) -> GeneratedObject:
    """Make a mobile phone on its back, its dark screen up."""
    size = (rng.uniform(0.068, 0.076), rng.uniform(0.14, 0.158), rng.uniform(0.0085, 0.01))
    body = make_prism([(size[0], size[1])], 0.009, size[2])
    name, color = pick_color(rng, ("black", "grey", "white", "light blue", "pink", "red"))
    screen = np.full((150, 75, 3), 26.0)
    screen[6:-6, 4:-4] = np.array([34.0, 38.0, 50.0])
    screen[10:16, 8:-8] = 60.0
    texture = split_bands((size[2] - 5e-4,), (fill_color(color), _project_from_above(screen, size)))
    return make_object("phone", name, body, texture, 0.18, 0.55, noun="mobile phone")


def make_remote(rng: np.random.Generator) -> GeneratedObject:
    """Make a remote control with rows of buttons."""
    size = (rng.uniform(0.042, 0.05), rng.uniform(0.15, 0.19), rng.uniform(0.016, 0.021))
    outlines = [(0.8 * size[0], 0.97 * size[1]), (size[0], size[1]), (0.95 * size[0], 0.99 * size[1])]
    body = make_prism(outlines, 0.008, size[2])
    name, color = pick_color(rng, ("black", "black", "grey", "white"))
    texture = split_bands((size[2] - 5e-4,), (fill_color(color), _project_from_above(_draw_buttons(rng, color), size)))
    return make_object("remote control", name, body, texture, 0.12, 0.1)


def _make_handle(start: float, end: float, end_height: float, half_width: float, arch: float = 0.006) -> Solid:
    """Make a flat bar along x that touches the table at its start and rises to `end_height` [m]."""
    t = np.linspace(0.0, 1.0, 6)
    thick = 0.0017
    height = thick + (end_height - thick) * t + arch * np.sin(np.pi * t)
    center = np.column_stack([start + (end - start) * t, 0 * t, height])
    widths = half_width * np.interp(t, [0.0, 0.15, 0.6, 1.0], [0.75, 1.0, 0.6, 0.55])
    rings = make_tube(center, np.column_stack([widths, np.full(6, thick)]), (0.0, 1.0, 0.0), around=8)
    return make_loft(rings, stride=2)


def _stretch(solid: Solid, x: float, y: float) -> Solid:
    scale = np.array([x, y, 1.0])
    return Solid(solid.manifold.scale(tuple(scale)), tuple(piece * scale for piece in solid.pieces))


def _make_cutlery(
    rng: np.random.Generator, label: str, body: Solid, handle_end: float | None = None
) -> GeneratedObject:
    kind = int(rng.integers(4))
    name, color = (
        ("steel", _STEEL * rng.uniform(0.85, 1.1)) if kind < 2 else pick_color(rng, ("red", "teal", "black", "white"))
    )
    texture, material, density = fill_color(color), name, 7600.0 if kind < 2 else 1200.0
    if kind == 3:
        grain = draw_wood(rng, (160, 40), np.array([196.0, 152.0, 104.0]), np.array([146.0, 104.0, 66.0]))
        texture, material, density = project_along(grain, (0, 1), (-0.1, -0.03), (0.1, 0.03)), "wooden", 750.0
    if handle_end is not None:
        handle = texture if kind > 1 else fill_color(0.4 * _STEEL)
        texture = split_bands((handle_end,), (handle, fill_color(_STEEL)), axis=0)
    mass = max(float(body.manifold.volume()) * density, 0.008)
    return make_object(label, material, body, texture, mass, 0.6 if kind < 2 else 0.05)


def _project_from_above(raster: Raster, size: tuple[float, float, float]) -> Texture:
    return project_along(raster, (0, 1), (-size[0] / 2, -size[1] / 2), (size[0] / 2, size[1] / 2))


def _draw_buttons(rng: np.random.Generator, case: Color) -> Raster:
    raster = np.broadcast_to(case, (180, 50, 3)).copy()
    key = np.array([210.0, 210.0, 208.0]) if case.mean() < 120 else np.array([70.0, 72.0, 78.0])
    for row in range(9):
        for column in range(3):
            raster[16 + 15 * row : 24 + 15 * row, 7 + 14 * column : 15 + 14 * column] = key
    raster[6:12, 7:15] = np.array([190.0, 40.0, 40.0])
    raster[16 + 15 * int(rng.integers(9)) :][:8, 7:15] = np.array([60.0, 120.0, 190.0])
    return raster


def make_wooden_spoon(rng: np.random.Generator) -> GeneratedObject:
    """Make a long cooking spoon of wood, nearly flat."""
    length, half = rng.uniform(0.2, 0.25), rng.uniform(0.021, 0.026)
    head = _stretch(revolve(np.array([[0.9, 0.0], [1.0, 0.003], [0.9, 0.006]])), 1.35 * half, half)
    head = head.translate((length / 2 - 1.35 * half, 0.0, 0.0))
    t = np.linspace(0.0, 1.0, 4)
    end = length / 2 - 2.2 * half
    center = np.column_stack([-length / 2 + (end + length / 2) * t, 0 * t, np.full(4, 0.0045)])
    body = head + make_loft(make_tube(center, np.full((4, 2), [0.0055, 0.0045]), (0.0, 1.0, 0.0), around=10), stride=3)
    grain = draw_wood(rng, (200, 40), np.array([204.0, 162.0, 112.0]), np.array([156.0, 112.0, 70.0]))
    texture = project_along(grain, (0, 1), (-length / 2, -half), (length / 2, half))
    mass = float(body.manifold.volume()) * 700.0
    return make_object("wooden spoon", "wooden", body, texture, mass, noun="cooking spoon")
