"""Photograph of a scene for display, read within bounds since it is untrusted."""

from PIL import Image

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import LARGE_IMAGE_BOUNDS, decode_image, open_image

PHOTOGRAPH = "observation/color.jpg"  # its name among the files of a scene

TALLEST = 4  # largest ratio of height to width: a strip of four pixels by seven hundred would be scaled to megabytes


def read_photograph(data: bytes, name: str, width: int) -> Image.Image:
    """Read the photograph in RGB, at most `width` wide [px]; a large JPEG is decoded at a fraction of its size."""
    image = open_image(data, name, LARGE_IMAGE_BOUNDS, "bad_photo")
    if image.height > TALLEST * image.width:
        raise InputError(f"{name} is {image.width} x {image.height} pixels: a strip, not a photograph", "bad_photo")
    size = (width, max(1, round(image.height * width / image.width)))
    image.draft("RGB", size)
    picture = Image.fromarray(decode_image(image, name, "RGB", "bad_photo"))
    return picture if picture.width <= width else picture.resize(size, Image.Resampling.LANCZOS)
