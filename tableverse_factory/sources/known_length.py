"""Known lengths of pictures: read from files, and converted to the pixels of the picture that is used."""

import json
from typing import Any

from schemas.known_length import KnownLength, Pixel, parse_known_length
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line

REASON = "bad_known_length"


def read_known_length(value: Any, origin: str) -> KnownLength:
    """Read a known length from JSON text or a parsed object; `origin` names its place in errors.

    Raises:
        InputError: `bad_known_length`.
    """
    try:
        return parse_known_length(value if isinstance(value, str) else json.dumps(value))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{origin}: {sanitize_line(str(error), 400)}", REASON) from None


def check_pixels(known: KnownLength, width: int, height: int) -> None:
    """Check that the pixels lie within a picture of this size, else raise `bad_known_length`."""
    for x, y in known.pixels:
        if x > width - 0.5 or y > height - 0.5:
            size = f"the upright picture has {width} x {height}"
            raise InputError(f"known_length: the pixel ({x:g}, {y:g}) lies outside: {size}", REASON)


def rescale_pixels(known: KnownLength, old: tuple[int, int], new: tuple[int, int]) -> KnownLength:
    """Convert the pixels from one size of the picture to another, each (width, height)."""

    def convert(pixel: Pixel) -> Pixel:
        x, y = ((at + 0.5) * after / before - 0.5 for at, before, after in zip(pixel, old, new, strict=True))
        return x, y

    return known if old == new else known.model_copy(update={"pixels": tuple(map(convert, known.pixels))})
