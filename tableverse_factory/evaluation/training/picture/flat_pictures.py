"""Pictures that show no table-top: portraits, logos, round things on plain ground, scans, cells, stars, pages."""

from collections.abc import Callable

import numpy as np
from PIL import Image, ImageDraw, ImageFilter, ImageFont

from tableverse_factory.evaluation.training.picture.patterns import (
    BLOCKS,
    SIDE,
    WORDS,
    Raster,
    Textures,
    draw_leaves,
    draw_pattern,
    make_noise,
    pick_color,
    pick_skin_color,
    to_bytes,
)

LARGE = 2 * SIDE  # side of the drawings, which are then halved [px]
INK = tuple[int, int, int]


def draw_flat_block(seed: int, count: int, block: int) -> Textures:
    """Draw a block's share of `count` pictures. Shape (n, 256, 256, 3)."""
    own = count * (block + 1) // BLOCKS - count * block // BLOCKS
    rng = np.random.default_rng([seed, block, 1])
    pictures = [_draw(rng) for _ in range(own)]
    return np.stack(pictures) if pictures else np.zeros((0, SIDE, SIDE, 3), dtype=np.uint8)


def _draw(rng: np.random.Generator) -> np.ndarray:
    make = _KINDS[int(rng.integers(len(_KINDS)))]
    image = Image.fromarray(to_bytes(make(rng)))
    return np.asarray(image.resize((SIDE, SIDE), Image.Resampling.BOX))


def _ground(rng: np.random.Generator, dark: float = 0.3) -> Image.Image:
    """Make a plain, shaded or cloudy ground; a share of `dark` of them is nearly black."""
    color = pick_color(rng) * (rng.uniform(0, 0.2) if rng.random() < dark else 1.0)
    other = color if rng.random() < 0.4 else np.clip(color * rng.uniform(0.5, 1.5), 0, 1)
    even = np.linspace(0, 1, SIDE)[:, None] * np.ones(SIDE)
    weight = even if rng.random() < 0.6 else make_noise(rng, (2, 2), 3)
    raster = color + weight[..., None] * (other - color)
    return Image.fromarray(to_bytes(raster)).resize((LARGE, LARGE), Image.Resampling.BILINEAR)


def _ink(color: np.ndarray) -> INK:
    red, green, blue = (int(v) for v in np.clip(255 * color, 0, 255))
    return red, green, blue


def _finish(rng: np.random.Generator, image: Image.Image, grain: float = 0.06) -> Raster:
    raster = np.asarray(image, dtype=np.float32) / 255
    return raster + rng.normal(0, rng.uniform(0, grain), (LARGE, LARGE, 1))


def _ellipse(
    draw: ImageDraw.ImageDraw, x: float, y: float, half: tuple[float, float], fill: INK | None, **line: object
) -> None:
    draw.ellipse((x - half[0], y - half[1], x + half[0], y + half[1]), fill=fill, **line)  # type: ignore[arg-type]


def _draw_portrait(rng: np.random.Generator) -> Raster:
    """Draw head and shoulders of a person or an animal, with hair, ears, eyes, nose and mouth."""
    image = _ground(rng, 0.15)
    if rng.random() < 0.5:
        leaves = Image.fromarray(to_bytes(draw_leaves(rng, [pick_color(rng) for _ in range(5)], 60)))
        image = leaves.resize((LARGE, LARGE)).filter(ImageFilter.GaussianBlur(rng.uniform(2, 20)))
    draw = ImageDraw.Draw(image)
    skin = pick_skin_color(rng) if rng.random() < 0.7 else pick_color(rng)
    size = LARGE * rng.uniform(0.14, 0.36)
    x, y = LARGE * rng.uniform(0.35, 0.65), LARGE * rng.uniform(0.3, 0.55)
    hair, cloth = _ink(pick_color(rng) * rng.uniform(0.1, 0.8)), _ink(pick_color(rng))
    _ellipse(draw, x, y + 2.3 * size, (size * rng.uniform(1.4, 2.4), 1.4 * size), cloth)
    draw.rectangle((x - 0.35 * size, y, x + 0.35 * size, y + 1.3 * size), fill=_ink(skin * 0.85))
    _ellipse(draw, x, y - 0.25 * size, (size * rng.uniform(0.9, 1.25), size * rng.uniform(1.0, 1.3)), hair)
    for side in (-1, 1) if rng.random() < 0.6 else ():
        _ellipse(
            draw, x + side * 0.8 * size, y - rng.uniform(0, 0.8) * size, (0.25 * size, 0.4 * size), _ink(skin * 0.9)
        )
    _ellipse(draw, x, y, (0.82 * size, size), _ink(skin))
    _ellipse(draw, x + 0.25 * size, y, (0.5 * size, 0.85 * size), _ink(skin * rng.uniform(0.8, 1.1)))
    for side in (-1, 1):
        at = x + side * 0.35 * size
        _ellipse(draw, at, y - 0.15 * size, (0.16 * size, 0.09 * size), _ink(np.full(3, 0.92)))
        _ellipse(draw, at, y - 0.15 * size, (0.08 * size, 0.08 * size), _ink(pick_color(rng) * 0.5))
    _ellipse(draw, x, y + 0.2 * size, (0.1 * size, 0.16 * size), _ink(skin * 0.85))
    _ellipse(draw, x, y + 0.5 * size, (0.3 * size, 0.08 * size), _ink(skin * np.array([0.9, 0.5, 0.5])))
    return _finish(rng, image.filter(ImageFilter.GaussianBlur(rng.uniform(0, 7))))


def _draw_logo(rng: np.random.Generator) -> Raster:
    """Draw a few shapes, curves and words on plain ground."""
    image = Image.new(
        "RGB", (LARGE, LARGE), _ink(pick_color(rng) if rng.random() < 0.5 else np.full(3, rng.uniform(0.8, 1)))
    )
    draw = ImageDraw.Draw(image)
    for _ in range(int(rng.integers(1, 7))):
        x, y = LARGE * rng.uniform(0.2, 0.8, 2)
        half, ink = LARGE * rng.uniform(0.05, 0.35, 2), _ink(pick_color(rng))
        kind = rng.random()
        if kind < 0.35:
            _ellipse(draw, x, y, (half[0], half[0]), ink)
        elif kind < 0.55:
            draw.rounded_rectangle((x - half[0], y - half[1], x + half[0], y + half[1]), half.min() * 0.4, fill=ink)
        elif kind < 0.75:
            draw.polygon([tuple(LARGE * rng.uniform(0.1, 0.9, 2)) for _ in range(int(rng.integers(3, 7)))], fill=ink)
        else:
            start = float(rng.uniform(0, 360))
            box = (x - half[0], y - half[1], x + half[0], y + half[1])
            draw.arc(box, start, start + float(rng.uniform(90, 330)), fill=ink, width=int(rng.integers(4, 50)))
    return _finish(rng, image, 0.03)


def _draw_disc(rng: np.random.Generator) -> Raster:
    """Draw one disc that fills most of a dark picture, with branching vessels and bright and dark spots in it."""
    ground = Image.new(
        "RGB", (LARGE, LARGE), _ink(np.full(3, rng.uniform(0, 0.12) if rng.random() < 0.8 else rng.random()))
    )
    color = (
        pick_color(rng)
        if rng.random() < 0.4
        else np.array([rng.uniform(0.5, 1), rng.uniform(0.15, 0.6), rng.uniform(0.0, 0.3)])
    )
    y, x = np.mgrid[:LARGE, :LARGE] / LARGE - 0.5
    shade = 1 - rng.uniform(0, 1.2) * np.hypot(x - rng.uniform(-0.2, 0.2), y - rng.uniform(-0.2, 0.2))
    disc = Image.fromarray(to_bytes(color * shade[..., None]))
    draw = ImageDraw.Draw(disc)
    for _ in range(int(rng.integers(0, 5))):
        place = LARGE * rng.uniform(0.25, 0.75, 2)
        half = LARGE * rng.uniform(0.02, 0.12)
        _ellipse(draw, place[0], place[1], (half, half * rng.uniform(0.7, 1)), _ink(color * rng.uniform(0.4, 1.8)))
    for _ in range(int(rng.integers(0, 14))):
        at, angle = LARGE * rng.uniform(0.35, 0.65, 2), rng.uniform(0, 2 * np.pi)
        path = [tuple(at)]
        for _ in range(30):
            angle += rng.normal(0, 0.25)
            at = at + 14 * np.array([np.cos(angle), np.sin(angle)])
            path.append(tuple(at))
        draw.line(path, fill=_ink(color * rng.uniform(0.4, 0.9)), width=int(rng.integers(1, 7)))
    mask = Image.new("L", (LARGE, LARGE), 0)
    half = LARGE * rng.uniform(0.3, 0.52)
    ImageDraw.Draw(mask).ellipse((LARGE / 2 - half, LARGE / 2 - half, LARGE / 2 + half, LARGE / 2 + half), fill=255)
    ground.paste(disc.filter(ImageFilter.GaussianBlur(rng.uniform(0, 3))), mask=mask)
    return _finish(rng, ground)


def _draw_scan(rng: np.random.Generator) -> Raster:
    """Draw a section through a body: grey ellipses in ellipses on black."""
    image = Image.new("L", (LARGE, LARGE), int(rng.integers(0, 40)))
    half = LARGE * rng.uniform(0.3, 0.48, 2)
    for level in range(int(rng.integers(4, 22))):
        own = half * (1.0 if level == 0 else 0.92 if level == 1 else rng.uniform(0.05, 0.45))
        shift = np.zeros(2) if level < 2 else rng.uniform(-0.5, 0.5, 2) * half
        layer = Image.new("L", (LARGE, LARGE), 0)
        low, high = LARGE / 2 + shift - own, LARGE / 2 + shift + own
        ImageDraw.Draw(layer).ellipse((*low, *high), fill=255)
        image.paste(int(rng.integers(0, 255)), mask=layer.rotate(float(rng.uniform(-40, 40)) if level > 1 else 0.0))
    return _finish(rng, image.filter(ImageFilter.GaussianBlur(rng.uniform(0, 4))).convert("RGB"), 0.1)


def _draw_coins(rng: np.random.Generator) -> Raster:
    """Draw discs with a relief on plain ground, seen straight from above without a shadow."""
    image = _ground(rng, 0.6)
    draw = ImageDraw.Draw(image)
    count = int(rng.integers(2, 7))
    metal = pick_color(rng) if rng.random() < 0.4 else np.full(3, rng.uniform(0.4, 0.9))
    for row in range(count):
        for column in range(count):
            if rng.random() < 0.15:
                continue
            x, y = (np.array([column, row]) + 0.5 + rng.uniform(-0.12, 0.12, 2)) * LARGE / count
            half = LARGE / count * rng.uniform(0.22, 0.46)
            tone = metal * rng.uniform(0.6, 1.2)
            _ellipse(draw, x, y, (half, half), _ink(tone))
            _ellipse(draw, x, y, (0.86 * half, 0.86 * half), None, outline=_ink(tone * 0.7), width=3)
            for _ in range(int(rng.integers(2, 8))):
                off, own = rng.uniform(-0.45, 0.45, 2) * half, rng.uniform(0.08, 0.4, 2) * half
                _ellipse(draw, x + off[0], y + off[1], (own[0], own[1]), _ink(tone * rng.uniform(0.6, 1.35)))
    grey = image.convert("L").convert("RGB") if rng.random() < 0.5 else image
    return _finish(rng, grey.filter(ImageFilter.GaussianBlur(rng.uniform(0.5, 3))), 0.1)


def _draw_cells(rng: np.random.Generator) -> Raster:
    """Draw stained cells with nuclei, bubbles or grains, all over."""
    image = _ground(rng)
    draw = ImageDraw.Draw(image)
    body, core = pick_color(rng), pick_color(rng)
    for _ in range(int(rng.integers(30, 400))):
        x, y = LARGE * rng.random(2)
        half = LARGE * rng.uniform(0.01, 0.05) * rng.uniform(0.7, 1.3, 2)
        _ellipse(draw, x, y, (half[0], half[1]), _ink(body * rng.uniform(0.7, 1.2)), outline=_ink(body * 0.5))
        _ellipse(draw, x, y, (0.5 * half[0], 0.5 * half[1]), _ink(core * rng.uniform(0.7, 1.2)))
    return _finish(rng, image.filter(ImageFilter.GaussianBlur(rng.uniform(0, 6))), 0.12)


def _draw_stars(rng: np.random.Generator) -> Raster:
    """Draw points and blurred spots of light on black."""
    light = make_noise(rng, (3, 3), 5) ** rng.uniform(2, 6) * rng.uniform(0, 0.5)
    image = Image.fromarray(to_bytes(light[..., None] * pick_color(rng))).resize((LARGE, LARGE))
    draw = ImageDraw.Draw(image)
    for _ in range(int(rng.integers(50, 900))):
        x, y = LARGE * rng.random(2)
        half = 0.7 + 5 * rng.random() ** 6
        _ellipse(draw, x, y, (half, half), _ink(np.clip(rng.uniform(0.4, 1) + rng.normal(0, 0.1, 3), 0, 1)))
    return _finish(rng, image.filter(ImageFilter.GaussianBlur(rng.uniform(0.5, 2.5))))


def _draw_page(rng: np.random.Generator) -> Raster:
    """Draw lines of words, of one or more sizes, lit unevenly."""
    ink, light = rng.uniform(0, 0.4), 0.6 + 0.4 * make_noise(rng, (2, 2), 2)
    image = Image.fromarray(to_bytes(light[..., None] * np.ones(3))).resize((LARGE, LARGE))
    draw, words, top = ImageDraw.Draw(image), WORDS.split(), float(rng.uniform(0, 30))
    while top < LARGE:
        size = int(rng.integers(12, 40))
        line = " ".join(rng.choice(words, 14))
        draw.text((rng.uniform(-20, 40), top), line, fill=_ink(np.full(3, ink)), font=ImageFont.load_default(size))
        top += size * rng.uniform(1.1, 1.8)
    return _finish(rng, image.filter(ImageFilter.GaussianBlur(rng.uniform(0, 2.5))))


def _draw_grating(rng: np.random.Generator) -> Raster:
    """Draw stripes, rings, steps of grey or noise."""
    y, x = np.mgrid[:LARGE, :LARGE] / LARGE - rng.uniform(0, 1, 2)[:, None, None]
    angle, count = rng.uniform(0, np.pi), rng.uniform(1, 40)
    kind = rng.random()
    along = np.cos(angle) * x + np.sin(angle) * y if kind < 0.5 else np.hypot(x, y)
    wave = 0.5 + 0.5 * np.sin(2 * np.pi * count * along)
    if kind > 0.8:
        wave = rng.random((LARGE, LARGE))
    one, other = pick_color(rng), pick_color(rng)
    return one + (wave > 0.5 if rng.random() < 0.4 else wave)[..., None] * (other - one)


def _draw_landscape(rng: np.random.Generator) -> Raster:
    """Draw a sky over ridges or roofs."""
    image = _ground(rng)
    draw = ImageDraw.Draw(image)
    for level in range(int(rng.integers(1, 5))):
        base, rough = LARGE * (0.35 + 0.15 * level + rng.uniform(-0.1, 0.1)), LARGE * rng.uniform(0.01, 0.12)
        count = int(rng.integers(4, 40))
        ridge = [(LARGE * k / count, base + float(rng.normal(0, rough))) for k in range(count + 1)]
        draw.polygon([(0, LARGE), *ridge, (LARGE, LARGE)], fill=_ink(pick_color(rng) * rng.uniform(0.3, 1)))
    noise = Image.fromarray(to_bytes(draw_pattern(rng))).resize((LARGE, LARGE))
    return _finish(rng, Image.blend(image, noise, float(rng.uniform(0, 0.4))))


def _draw_surface(rng: np.random.Generator) -> Raster:
    """Draw a wall or a ground straight from the front."""
    raster = Image.fromarray(to_bytes(draw_pattern(rng))).resize((LARGE, LARGE), Image.Resampling.BICUBIC)
    return _finish(rng, raster)


_KINDS: tuple[Callable[[np.random.Generator], Raster], ...] = (
    _draw_portrait,
    _draw_portrait,
    _draw_logo,
    _draw_disc,
    _draw_scan,
    _draw_coins,
    _draw_cells,
    _draw_stars,
    _draw_page,
    _draw_grating,
    _draw_landscape,
    _draw_surface,
)
