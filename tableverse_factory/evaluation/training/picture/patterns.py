"""Procedural textures: wood, stone, cloth, carpets, tiles, pages, and printed faces of packages."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

SIDE = 256  # of a texture [px]
FACES = 3  # textures of one printed package, one after the other
BLOCKS = 40  # of textures, each drawn from a seed of its own

Color = np.ndarray  # sRGB in 0-1, shape (3,)
Raster = Float[np.ndarray, "h w 3"]
Textures = UInt8[np.ndarray, "n 256 256 3"]

WORDS = (
    "CORN RICE MILK TEA SALT SUGAR FRESH NATURAL 500g OATS SOUP COLA FLOUR BEANS JUICE MINT CAKE NEW BIO 24 SOAP "
    "CLEAN MAX VITA CHOCO HONEY BREAD net weight ingredients made in best before family size 1kg free original"
)


def make_textures(seed: int, packages: int, patterns: int) -> Textures:
    """Draw the printed faces of `packages`, three each, and then `patterns`."""
    rng = np.random.default_rng(seed)
    printed = [face for _ in range(packages) for face in _draw_package(rng)]
    plain = [to_bytes(draw_pattern(rng)) for _ in range(patterns)]
    return np.stack([*printed, *plain]) if printed or plain else np.zeros((0, SIDE, SIDE, 3), dtype=np.uint8)


def draw_block(seed: int, packages: int, patterns: int, block: int) -> tuple[Textures, Textures]:
    """Draw a block's share of the packages and of the patterns."""
    own = [count * (block + 1) // BLOCKS - count * block // BLOCKS for count in (packages, patterns)]
    textures = make_textures(seed * BLOCKS + block, *own)
    split = len(textures) - own[1]
    return textures[:split], textures[split:]


def pick_color(rng: np.random.Generator) -> Color:
    """Pick a colour: greys, saturated ones, and those of wood, skin and card."""
    kind = rng.random()
    if kind < 0.25:
        return np.clip(rng.uniform(0.03, 0.97) + rng.normal(0, 0.03, 3), 0.02, 0.98)
    if kind < 0.6:
        return _from_hue(rng.random() * 6, rng.uniform(0.15, 1) ** 0.8, rng.uniform(0.15, 1))
    if kind < 0.8:
        return _from_hue(rng.uniform(0.2, 1.0), rng.uniform(0.15, 0.7), rng.uniform(0.25, 0.95))
    return rng.random(3)


def pick_wood_color(rng: np.random.Generator) -> Color:
    """Pick a colour of wood."""
    return _from_hue(rng.uniform(0.35, 0.75), rng.uniform(0.12, 0.6), rng.uniform(0.25, 0.95))


def pick_skin_color(rng: np.random.Generator) -> Color:
    """Pick a colour of skin."""
    return _from_hue(rng.uniform(0.25, 0.6), rng.uniform(0.25, 0.6), rng.uniform(0.3, 0.98))


def _from_hue(hue: float, saturation: float, value: float) -> Color:
    sector, part = int(hue) % 6, hue - int(hue)
    low, fall = value * (1 - saturation), value * (1 - saturation * part)
    rise = value * (1 - saturation * (1 - part))
    options = (
        (value, rise, low),
        (fall, value, low),
        (low, value, rise),
        (low, fall, value),
        (rise, low, value),
        (value, low, fall),
    )
    return np.array(options[sector])


def to_bytes(raster: Raster) -> UInt8[np.ndarray, "h w 3"]:
    """Round sRGB in 0-1 to bytes."""
    return np.round(255 * np.clip(raster, 0, 1)).astype(np.uint8)


def make_noise(
    rng: np.random.Generator, cells: tuple[int, int], octaves: int = 4, gain: float = 0.5
) -> Float[np.ndarray, "256 256"]:
    """Make smooth noise in 0-1 that repeats; `cells` are those of the coarsest octave, down and across."""
    total = np.zeros((SIDE, SIDE), dtype=np.float32)
    for octave in range(octaves):
        rows, columns = (min(count << octave, SIDE) for count in cells)
        lattice = np.pad(rng.random((rows, columns), dtype=np.float32), ((0, 1), (0, 1)), mode="wrap")
        size = (SIDE + SIDE // columns, SIDE + SIDE // rows)
        image = Image.fromarray(lattice).resize(size, Image.Resampling.BICUBIC)
        total += np.asarray(image)[:SIDE, :SIDE] * np.float32(gain**octave)
    total -= total.min()
    return total / max(float(total.max()), 1e-6)


def _blend(weight: np.ndarray, colors: Sequence[Color]) -> Raster:
    steps = np.linspace(0, 1, len(colors))
    return np.stack([np.interp(weight, steps, [color[k] for color in colors]) for k in range(3)], axis=-1)


def _pick(rng: np.random.Generator, low: int, high: int) -> list[Color]:
    return [pick_color(rng) for _ in range(int(rng.integers(low, high)))]


def _grid() -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE
    return x, y


def draw_wood(rng: np.random.Generator) -> Raster:
    """Draw grain along the width, often in planks."""
    light = pick_wood_color(rng)
    grain = make_noise(rng, (24, 2))
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (rng.uniform(3, 10) * make_noise(rng, (4, 1), 2) + 2 * grain))
    weight = 0.55 * grain + rng.uniform(0, 0.4) * rings
    planks = int(rng.choice([1, 1, 2, 3, 4]))
    rows = np.arange(SIDE) * planks // SIDE
    weight = weight + rng.uniform(-0.12, 0.12, planks)[rows][:, None]
    if planks > 1:
        weight[np.diff(rows, prepend=-1) > 0] += rng.uniform(0, 0.6)
    return _blend(np.clip(weight, 0, 1), [light, light * rng.uniform(0.55, 0.92)])


def _draw_clouds(rng: np.random.Generator) -> Raster:
    cells = (int(rng.integers(1, 8)), int(rng.integers(1, 8)))
    return _blend(make_noise(rng, cells, int(rng.integers(1, 6)), rng.uniform(0.4, 0.9)), _pick(rng, 2, 5))


def _draw_grain(rng: np.random.Generator) -> Raster:
    fine = (make_noise(rng, (64, 64), 2)[..., None] - 0.5) * rng.uniform(0, 0.4)
    broad = (make_noise(rng, (3, 3), 2)[..., None] - 0.5) * rng.uniform(0, 0.1)
    return pick_color(rng) + rng.normal(0, rng.uniform(0.01, 0.15), (SIDE, SIDE, 1)) + fine + broad


def _draw_stripes(rng: np.random.Generator) -> Raster:
    x, y = _grid()
    weight = ((x * rng.integers(1, 14)) % 1 < rng.uniform(0.1, 0.9)).astype(float)
    if rng.random() < 0.5:
        weight = (weight + ((y * rng.integers(1, 14)) % 1 < rng.uniform(0.1, 0.9))) / 2
    return _blend(weight, _pick(rng, 3, 4))


def _draw_checkers(rng: np.random.Generator) -> Raster:
    x, y = _grid()
    count = 2 * int(rng.integers(1, 6))
    weight = ((x * count).astype(int) + (y * count).astype(int)) % 2
    return _blend(weight, _pick(rng, 2, 3)) + (make_noise(rng, (4, 4), 3)[..., None] - 0.5) * rng.uniform(0, 0.2)


def _draw_tiles(rng: np.random.Generator) -> Raster:
    x, y = _grid()
    rows = int(rng.integers(2, 9))
    columns = max(1, rows // int(rng.integers(1, 3)))
    shift = 0.5 * ((y * rows).astype(int) % 2) * (rng.random() < 0.6)
    line = ((x * columns + shift) % 1 < 0.05) | ((y * rows) % 1 < 0.07)
    tone = rng.uniform(-0.08, 0.08, (64, 64))[(x * columns + shift).astype(int) % columns, (y * rows).astype(int)]
    return pick_color(rng) + tone[..., None] - line[..., None] * rng.uniform(-0.4, 0.4)


def draw_leaves(rng: np.random.Generator, colors: Sequence[Color], count: int = 160) -> Raster:
    """Draw shapes over shapes, ever smaller, as of a photograph."""
    image = Image.new("RGB", (SIDE, SIDE), _ink(colors[0]))
    draw = ImageDraw.Draw(image)
    for k in range(count):
        r = SIDE * 0.5 * (1 - k / count) ** 2 * rng.uniform(0.3, 1) + 1.5
        x, y = rng.uniform(0, SIDE, 2)
        fill = _ink(colors[int(rng.integers(len(colors)))] + rng.normal(0, 0.05, 3))
        kind = int(rng.integers(3))
        if kind == 0:
            draw.ellipse((x - r, y - r * rng.uniform(0.4, 1), x + r, y + r * 0.7), fill=fill)
        elif kind == 1:
            draw.rectangle((x - r, y - r * rng.uniform(0.2, 1), x + r, y + r * 0.6), fill=fill)
        else:
            turns = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 6))))
            draw.polygon([(x + r * np.cos(a), y + r * np.sin(a)) for a in turns], fill=fill)
    return np.asarray(image, dtype=np.float32) / 255


def _draw_photograph(rng: np.random.Generator) -> Raster:
    return draw_leaves(rng, _pick(rng, 3, 8))


def _draw_cells(rng: np.random.Generator) -> Raster:
    x, y = _grid()
    nearest, index = np.full((SIDE, SIDE), 9.0), np.zeros((SIDE, SIDE), dtype=int)
    for k, (a, b) in enumerate(rng.random((int(rng.integers(8, 60)), 2))):
        dx, dy = np.abs(x - a), np.abs(y - b)
        distance = np.minimum(dx, 1 - dx) ** 2 + np.minimum(dy, 1 - dy) ** 2
        closer = distance < nearest
        nearest[closer], index[closer] = distance[closer], k
    return np.array(_pick(rng, 5, 6))[index % 5]


def _draw_carpet(rng: np.random.Generator) -> Raster:
    """Draw a carpet: a mirrored field of motifs within borders, and its pile."""
    half = draw_leaves(rng, _pick(rng, 3, 6), 60)[: SIDE // 2, : SIDE // 2]
    quarter = np.concatenate([half, half[:, ::-1]], axis=1)
    field = np.concatenate([quarter, quarter[::-1]], axis=0)
    x, y = _grid()
    edge = np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y))
    for width in rng.uniform(0.02, 0.14, int(rng.integers(0, 4))):
        field[(edge > width) & (edge < width + 0.02)] = pick_color(rng)
    return field * rng.uniform(0.6, 1) + rng.normal(0, rng.uniform(0.02, 0.12), (SIDE, SIDE, 1))


def _draw_weave(rng: np.random.Generator) -> Raster:
    x, y = _grid()
    count = int(rng.integers(16, 64))
    over = 0.5 + 0.25 * np.sin(2 * np.pi * x * count) + 0.25 * np.sin(2 * np.pi * y * count)
    broad = make_noise(rng, (int(rng.integers(1, 5)),) * 2, 3)
    return _blend(np.clip(0.6 * over + 0.5 * broad - 0.05, 0, 1), _pick(rng, 2, 4))


def _draw_page(rng: np.random.Generator) -> Raster:
    """Draw a page of lines of text, or the squares of a marker board."""
    paper = np.full((SIDE, SIDE, 3), rng.uniform(0.75, 1.0))
    if rng.random() < 0.3:
        count = int(rng.integers(4, 10))
        bits = rng.random((count, count)) < 0.5
        paper[np.kron(bits, np.ones((SIDE // count,) * 2, dtype=bool)).nonzero()] = rng.uniform(0, 0.2)
        return paper
    step = int(rng.integers(6, 16))
    for top in range(step, SIDE - step, step):
        left = int(rng.uniform(0.04, 0.1) * SIDE)
        while left < rng.uniform(0.6, 0.95) * SIDE:
            width = int(rng.integers(4, 28))
            paper[top : top + max(2, step // 2), left : left + width] *= rng.uniform(0.2, 0.5)
            left += width + step // 2
    return paper


_PATTERNS: tuple[tuple[float, Callable[[np.random.Generator], Raster]], ...] = (
    (9, draw_wood),
    (6, _draw_clouds),
    (5, _draw_grain),
    (3, _draw_stripes),
    (2, _draw_checkers),
    (2, _draw_tiles),
    (4, _draw_photograph),
    (2, _draw_cells),
    (4, _draw_carpet),
    (3, _draw_weave),
    (1, _draw_page),
)


def draw_pattern(rng: np.random.Generator) -> Raster:
    """Draw a pattern of a random kind."""
    weights = np.array([weight for weight, _ in _PATTERNS])
    return _PATTERNS[int(rng.choice(len(_PATTERNS), p=weights / weights.sum()))][1](rng)


def _ink(color: Color) -> tuple[int, int, int]:
    red, green, blue = (int(v) for v in np.clip(255 * color, 0, 255))
    return red, green, blue


def _draw_package(rng: np.random.Generator) -> list[UInt8[np.ndarray, "256 256 3"]]:
    """Draw top, side and front of a package in one palette."""
    palette = _pick(rng, 2, 5)
    return [_draw_face(rng, palette) for _ in range(FACES)]


def _draw_face(rng: np.random.Generator, palette: Sequence[Color]) -> UInt8[np.ndarray, "256 256 3"]:
    """Draw a printed face: ground, blocks of colour, a photograph, a logo, words, small print, a bar code."""
    ground = np.broadcast_to(palette[0], (SIDE, SIDE, 3))
    if rng.random() < 0.5:
        ground = _blend(make_noise(rng, (2, 2), 3), [palette[0], palette[int(rng.integers(len(palette)))]])
    image = Image.fromarray(to_bytes(ground))
    draw = ImageDraw.Draw(image)
    for _ in range(int(rng.integers(1, 9))):
        _draw_block(rng, draw, _ink(palette[int(rng.integers(len(palette)))]))
    if rng.random() < 0.6:
        side = int(rng.uniform(0.25, 0.95) * SIDE)
        photograph = to_bytes(draw_leaves(rng, [*_pick(rng, 4, 5), *palette]))[:side, :side]
        image.paste(Image.fromarray(photograph), (int(rng.uniform(0, SIDE - side)), int(rng.uniform(0, SIDE - side))))
    for _ in range(int(rng.integers(0, 6))):
        ink = palette[int(rng.integers(len(palette)))] if rng.random() < 0.6 else pick_color(rng)
        _draw_words(rng, image, _ink(ink))
    if rng.random() < 0.5:
        _draw_small_print(rng, draw, _ink(palette[-1]))
    if rng.random() < 0.25:
        _draw_bar_code(rng, draw)
    if rng.random() < 0.3:
        inset, width = int(rng.integers(2, 20)), int(rng.integers(2, 8))
        draw.rectangle((inset, inset, SIDE - inset, SIDE - inset), outline=_ink(pick_color(rng)), width=width)
    return np.asarray(image)


def _draw_block(rng: np.random.Generator, draw: ImageDraw.ImageDraw, fill: tuple[int, int, int]) -> None:
    x, y = rng.uniform(-0.2, 0.8, 2) * SIDE
    width, height = rng.uniform(0.1, 1.2, 2) * SIDE
    kind = int(rng.integers(4))
    if kind == 0:
        draw.rectangle((x, y, x + width, y + height), fill=fill)
    elif kind == 1:
        draw.ellipse((x, y, x + width, y + height), fill=fill)
    elif kind == 2:
        draw.polygon([tuple(rng.uniform(0, SIDE, 2)) for _ in range(3)], fill=fill)
    else:
        edge = rng.uniform(0.1, 0.9) * SIDE
        low = bool(rng.integers(2))
        box = (0, edge, SIDE, SIDE) if rng.random() < 0.6 else (edge, 0, SIDE, SIDE)
        draw.rectangle(box if low else (0, 0, *((SIDE, edge) if box[0] == 0 else (edge, SIDE))), fill=fill)


def _draw_words(rng: np.random.Generator, image: Image.Image, ink: tuple[int, int, int]) -> None:
    words = " ".join(rng.choice(WORDS.split(), int(rng.integers(1, 4))))
    font = ImageFont.load_default_imagefont()
    left, top, right, bottom = font.getbbox(words)
    mask = Image.new("L", (int(right - left), int(bottom - top)), 0)
    ImageDraw.Draw(mask).text((-left, -top), words, fill=255, font=font)
    scale = rng.uniform(0.3, 0.95) * SIDE / mask.width
    size = (max(4, int(mask.width * scale)), max(4, int(mask.height * scale * rng.uniform(0.7, 1.6))))
    mask = mask.resize(size)
    if rng.random() < 0.3:
        mask = mask.rotate(float(rng.choice([90, -90, rng.uniform(-40, 40)])), expand=True)
    image.paste(ink, (int(rng.uniform(-0.05, 0.4) * SIDE), int(rng.uniform(0.02, 0.85) * SIDE)), mask)


def _draw_small_print(rng: np.random.Generator, draw: ImageDraw.ImageDraw, ink: tuple[int, int, int]) -> None:
    x, y = rng.uniform(0.05, 0.5) * SIDE, rng.uniform(0.1, 0.8) * SIDE
    step = int(rng.integers(4, 9))
    for line in range(int(rng.integers(2, 14))):
        top = y + line * step
        draw.rectangle((x, top, x + rng.uniform(0.2, 0.5) * SIDE, top + max(1, step // 3)), fill=ink)


def _draw_bar_code(rng: np.random.Generator, draw: ImageDraw.ImageDraw) -> None:
    x, y = rng.uniform(0.05, 0.7, 2) * SIDE
    draw.rectangle((x, y, x + 70, y + 44), fill=(250, 250, 250))
    for offset in range(4, 66, 3):
        draw.rectangle((x + offset, y + 4, x + offset + int(rng.integers(0, 3)), y + 38), fill=(10, 10, 10))
