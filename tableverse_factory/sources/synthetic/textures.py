"""Colours of generated objects: rasters (noise, wood, printed labels), and mappings onto surfaces."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32
from PIL import Image, ImageDraw, ImageFont

from schemas.geometry import Picture, Points
from tableverse_factory.sources.synthetic.colors import Color, find_ink_color
from tableverse_factory.sources.synthetic.model import Texture

Raster = Float32[np.ndarray, "h w 3"]  # sRGB in 0–255, first row on top


def fill_color(color: Color) -> Texture:
    """Use one colour all over."""
    return lambda points: np.broadcast_to(color, points.shape)


def make_lattice_noise(
    rng: np.random.Generator, size: tuple[int, int], cells: tuple[int, int], octaves: int = 4
) -> np.ndarray:
    """Make smooth random heights in 0–1, each octave half as strong and twice as fine. Shape (h, w).

    `size` is width and height [px]; the coarsest octave has `cells` along them.
    """
    total = np.zeros((size[1], size[0]), dtype=np.float32)
    for octave in range(octaves):
        shape = (min(cells[1] << octave, size[1]) + 1, min(cells[0] << octave, size[0]) + 1)
        lattice = Image.fromarray(rng.random(shape, dtype=np.float32))
        total += np.asarray(lattice.resize(size, Image.Resampling.BICUBIC)) * np.float32(0.5**octave)
    low, high = total.min(), total.max()
    return (total - low) / max(high - low, 1e-9)


def blend_colors(a: Color, b: Color, weight: np.ndarray) -> Raster:
    """Blend from `a` where the weight is 0 to `b` where it is 1."""
    share = np.clip(weight, 0.0, 1.0).astype(np.float32)[..., None]
    return a.astype(np.float32) + (b - a).astype(np.float32) * share


def sample_raster(raster: Raster, u: np.ndarray, v: np.ndarray) -> Points:
    """Sample a raster at u to the right and v upwards, both 0–1 and clamped. Shape (n, 3)."""
    height, width = raster.shape[:2]
    column = np.clip((u * width).astype(np.intp), 0, width - 1)
    row = np.clip(((1.0 - v) * height).astype(np.intp), 0, height - 1)
    return raster[row, column]


def wrap_around_z(raster: Raster, low: float, high: float) -> Texture:
    """Wrap a raster round the z axis from height `low` to `high` [m]; its middle faces -y."""

    def color(points: Points) -> Points:
        u = np.arctan2(points[:, 0], -points[:, 1]) / (2 * np.pi) + 0.5
        return sample_raster(raster, u, (points[:, 2] - low) / (high - low))

    return color


def project_along(raster: Raster, axes: tuple[int, int], low: Sequence[float], high: Sequence[float]) -> Texture:
    """Project a raster along the third axis, stretched over a rectangle [m]."""

    def color(points: Points) -> Points:
        u, v = ((points[:, axis] - a) / (b - a) for axis, a, b in zip(axes, low, high, strict=True))
        return sample_raster(raster, u, v)

    return color


def tile_picture(picture: Picture, side_m: float) -> Texture:
    """Repeat a picture over the plane z = 0, a tile `side_m` long [m], its first row towards +y."""
    raster: Raster = picture.astype(np.float32)

    def color(points: Points) -> Points:
        share = points[:, :2] / side_m
        u, v = (share - np.floor(share)).T
        return sample_raster(raster, u, v)

    return color


def map_to_box(rasters: Sequence[Raster], size: Sequence[float]) -> Texture:
    """Map a raster to each face of a box that stands on z = 0: front (-y), right, back, left, top, bottom."""
    half = np.asarray(size, dtype=np.float64) / 2

    def color(points: Points) -> Points:
        scaled = (points - [0.0, 0.0, half[2]]) / half
        axis = np.argmax(np.abs(scaled), axis=1)
        positive = scaled[np.arange(len(points)), axis] > 0.0
        face = np.choose(axis, [np.where(positive, 1, 3), np.where(positive, 2, 0), np.where(positive, 4, 5)])
        x, y, z = (0.5 + 0.5 * scaled).T
        u = np.choose(face, [x, y, 1.0 - x, 1.0 - y, x, x])
        v = np.choose(face, [z, z, z, z, y, 1.0 - y])
        colors = np.empty_like(points)
        for index, raster in enumerate(rasters):
            here = face == index
            colors[here] = sample_raster(raster, u[here], v[here])
        return colors

    return color


def split_bands(edges: Sequence[float], textures: Sequence[Texture], axis: int = 2) -> Texture:
    """Choose a texture by position along an axis: the first below `edges[0]`, the last above `edges[-1]` [m]."""

    def color(points: Points) -> Points:
        band = np.searchsorted(np.asarray(edges), points[:, axis])
        colors = np.empty_like(points)
        for index, texture in enumerate(textures):
            here = band == index
            colors[here] = texture(points[here])
        return colors

    return color


def draw_label(
    rng: np.random.Generator, size: tuple[int, int], background: Color, accent: Color, words: Sequence[str]
) -> Raster:
    """Draw the label of a package: a field of the accent colour, large words, a sign, small print."""
    width, height = size
    image = Image.fromarray(_draw_background(rng, size, background, accent).astype(np.uint8))
    draw = ImageDraw.Draw(image)
    ink = _round_color(find_ink_color(background))
    center = (width * rng.uniform(0.35, 0.65), height * rng.uniform(0.55, 0.68))
    radius = min(size) * rng.uniform(0.16, 0.28)
    box = (center[0] - radius, center[1] - radius, center[0] + radius, center[1] + radius)
    (draw.ellipse if rng.random() < 0.6 else draw.rectangle)(box, fill=ink)
    inset = 0.25 * radius
    inner = (box[0] + inset, box[1] + inset, box[2] - inset, box[3] - inset)
    draw.ellipse(inner, fill=_round_color(accent))
    for line, word in enumerate(words):
        _draw_text(image, word, (width * 0.08, height * (0.08 + 0.15 * line)), (width * 0.84, height * 0.13), ink)
    for line in range(4):
        y = height * (0.88 + 0.025 * line)
        draw.rectangle((width * 0.1, y, width * rng.uniform(0.5, 0.9), y + max(1.0, height * 0.008)), fill=ink)
    return np.asarray(image, dtype=np.float32)


def _draw_background(rng: np.random.Generator, size: tuple[int, int], background: Color, accent: Color) -> Raster:
    width, height = size
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    kind = int(rng.integers(4))
    if kind == 0:
        weight = (y > rng.uniform(0.4, 0.55)).astype(np.float64)
    elif kind == 1:
        weight = (y > 0.5 + 0.12 * np.sin(2 * np.pi * (x * rng.uniform(0.7, 1.6) + rng.random()))).astype(np.float64)
    elif kind == 2:
        weight = (((x + y * rng.uniform(0.3, 1.0)) % 0.25 < 0.1) & (y > 0.42)).astype(np.float64)
    else:
        weight = np.clip(1.6 * y - 0.5, 0.0, 1.0)
    return blend_colors(background, accent, weight)


def _draw_text(
    image: Image.Image, text: str, corner: tuple[float, float], room: tuple[float, float], ink: tuple[int, int, int]
) -> None:
    # The font that Pillow carries in its source, enlarged: the same letters wherever Pillow runs, FreeType or not.
    font = ImageFont.load_default_imagefont()
    left, top, right, bottom = font.getbbox(text)
    letters = Image.new("L", (int(right - left), int(bottom - top)), 0)
    ImageDraw.Draw(letters).text((-left, -top), text, fill=255, font=font)
    scale = min(room[0] / letters.width, room[1] / letters.height)
    letters = letters.resize((max(1, int(letters.width * scale)), max(1, int(letters.height * scale))))
    image.paste(ink, (int(corner[0]), int(corner[1])), letters)


def _round_color(color: Color) -> tuple[int, int, int]:
    red, green, blue = (int(c) for c in color)
    return red, green, blue


def draw_wood(rng: np.random.Generator, size: tuple[int, int], light: Color, dark: Color, planks: int = 1) -> Raster:
    """Draw grain along the width, in planks of slightly different tone."""
    grain = make_lattice_noise(rng, size, (3, 40), 4)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (8.0 * make_lattice_noise(rng, size, (2, 6), 2) + 2.0 * grain))
    weight = 0.55 * grain + 0.25 * rings
    rows = np.arange(size[1]) * planks // size[1]
    weight = weight + rng.uniform(-0.12, 0.12, planks)[rows][:, None]
    seam = np.diff(rows, prepend=rows[0]) > 0
    weight[seam] += 0.5
    return blend_colors(light, dark, weight)


def draw_speckles(rng: np.random.Generator, size: tuple[int, int], base: Color, grain: Color) -> Raster:
    """Draw fine speckles."""
    fine = make_lattice_noise(rng, size, (size[0] // 6, size[1] // 6), 2)
    weight = np.clip(2.5 * (fine - 0.5), 0.0, 0.7) + 0.1 * make_lattice_noise(rng, size, (5, 5), 2)
    return blend_colors(base, grain, weight)
