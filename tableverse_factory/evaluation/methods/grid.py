"""Grid picture on which a judge compares methods (paper, appendix C.3).

Upper row: the real picture, then each method from the front and slightly above. Lower row: a blank, then each method
from straight ahead, which shows floating and sunken objects. Only objects are drawn, no table. Columns have letters.
"""

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

from schemas.geometry import Picture, TriangleMesh
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.png import encode_png
from tableverse_factory.evaluation.methods.scenes import MethodScene
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.physics.mjcf.scenery import Rgb, Scenery
from tableverse_factory.physics.render.views import FINE, make_front_camera, render_pictures

OBLIQUE = float(np.deg2rad(25.0))
CELL = 448  # side of a cell [px]

HEADER = 28  # height of the header with the letters [px]

MAX_REFERENCE_PIXELS = 40_000_000

_PAPER = "white"
_INK = "#24292f"


def make_letters(count: int) -> tuple[str, ...]:
    """Make the letters of the columns from the left."""
    return tuple(chr(ord("A") + index) for index in range(count))


def render_method(scene: MethodScene, side: int = CELL) -> tuple[Picture, Picture]:
    """Render a scene from the front and slightly above, and from straight ahead; each `side` square [px]."""
    scenery = build_scenery(scene)
    cameras = [make_front_camera(scenery, side, side, elevation=elevation) for elevation in (OBLIQUE, 0.0)]
    oblique, front = render_pictures(scenery, cameras, FINE)
    return oblique.color, front.color


def build_scenery(scene: MethodScene) -> Scenery:
    """Build the drawable objects of a scene."""
    names: list[str] = []
    parts: list[TriangleMesh] = []
    colors: list[Rgb | None] = []
    for item in scene.objects:
        for look in item.looks:
            names.append(item.name)
            parts.append(place_mesh(look.mesh, item.pose, item.scale))
            plain = look.mesh.texture is None and look.mesh.vertex_colors is None
            colors.append(look.color if plain else None)
    return Scenery(tuple(names), tuple(parts), tuple(colors))


def stitch_grid(reference: Image.Image, views: Sequence[tuple[Picture, Picture]], side: int = CELL) -> bytes:
    """Stitch the grid as a PNG file: a column for the reference and one per method, in the given order."""
    grid = Image.new("RGB", (side * (1 + len(views)), HEADER + 2 * side), _PAPER)
    draw = ImageDraw.Draw(grid)
    font = ImageFont.load_default(size=HEADER - 8)
    for column, title in enumerate(("Reference", *make_letters(len(views)))):
        draw.text((column * side + side / 2, HEADER / 2), title, fill=_INK, font=font, anchor="mm")
        draw.line([(column * side, 0), (column * side, grid.height)], fill=_INK)
    fitted = ImageOps.contain(reference, (side, side))
    grid.paste(fitted, ((side - fitted.width) // 2, HEADER + (side - fitted.height) // 2))
    for column, pair in enumerate(views, start=1):
        for row, view in enumerate(pair):
            grid.paste(Image.fromarray(np.asarray(view)), (column * side + 1, HEADER + row * side))
    return encode_png(grid, compress_level=6)


def read_reference(data: bytes, name: str) -> Image.Image:
    """Decode a real picture, upright and in RGB; raise `bad_reference` if it cannot be decoded or is too large."""
    try:
        picture = Image.open(io.BytesIO(data))
        if picture.width * picture.height > MAX_REFERENCE_PIXELS:
            raise InputError(f"{name}: {picture.width} x {picture.height} pixels are too many", "bad_reference")
        return ImageOps.exif_transpose(picture).convert("RGB")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{name} is not a readable picture: {error}"[:300], "bad_reference") from error
