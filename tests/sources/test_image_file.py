"""Bare pictures: upright whatever way the camera was held, and only what becomes sRGB without a guess."""

import io

import numpy as np
import pytest
from PIL import Image

from schemas.config import ObserveConfig
from tableverse_factory.core.errors import InputError
from tableverse_factory.sources.image_file import decode_upright
from tests.helpers.picture_server import encoded, photo

BOUNDS = ObserveConfig()
MIRRORED = Image.Transpose.FLIP_LEFT_RIGHT
HELD = {
    1: (),
    2: (MIRRORED,),
    3: (Image.Transpose.ROTATE_180,),
    4: (MIRRORED, Image.Transpose.ROTATE_180),
    5: (MIRRORED, Image.Transpose.ROTATE_90),
    6: (Image.Transpose.ROTATE_90,),
    7: (MIRRORED, Image.Transpose.ROTATE_270),
    8: (Image.Transpose.ROTATE_270,),
}
"""How an upright picture lies in a file with each value of the tag (EXIF 2.3, table of Orientation)."""


@pytest.mark.parametrize("orientation", HELD)
@pytest.mark.parametrize("form", ["PNG", "WEBP"])
def test_pixels_are_upright(orientation, form):
    upright = photo(1, (40, 30))
    lying = upright
    for turn in HELD[orientation]:
        lying = lying.transpose(turn)
    exif = Image.Exif()
    exif[0x0112] = orientation
    data = encoded(lying, form, exif=exif, **({"lossless": True} if form == "WEBP" else {}))
    assert np.array_equal(decode_upright(data, "a", BOUNDS), np.asarray(upright))


@pytest.mark.parametrize(
    "exif", [b"Exif\0\0nonsense", b"Exif\0\0II*\0\xff\xff\xff\xff", b"Exif\0\0MM\0*\0\0\0\x08\xff\xff"]
)
def test_a_broken_note_beside_sound_pixels_turns_nothing(exif):
    image = photo(2, (40, 30))
    assert decode_upright(encoded(image, exif=exif), "a", BOUNDS).shape == (30, 40, 3)


def test_grey_palettes_and_opaque_alpha_are_taken():
    image = photo(3, (40, 30))
    for mode in ("L", "P", "RGBA", "LA"):
        expected = np.asarray(image.convert(mode).convert("RGB"))
        assert np.array_equal(decode_upright(encoded(image.convert(mode), "PNG"), "a", BOUNDS), expected)


def test_a_palette_whose_transparency_hides_nothing_is_taken():
    image = photo(3, (40, 30)).quantize(8)
    opaque = encoded(image, "PNG", transparency=bytes([255] * 8))
    assert np.array_equal(decode_upright(opaque, "a", BOUNDS), np.asarray(image.convert("RGB")))


def test_the_first_picture_of_a_phone_counts():
    data = encoded(photo(4, (40, 30)), "MPO", save_all=True, append_images=[photo(5, (20, 15))])
    assert decode_upright(data, "a", BOUNDS).shape == (30, 40, 3)


@pytest.mark.heavy
def test_a_text_that_unpacks_to_very_much_is_not_unpacked():
    from PIL.PngImagePlugin import PngInfo

    note = PngInfo()
    note.add_text("bomb", "x" * 100_000_000, zip=True)
    out = io.BytesIO()
    photo(1, (40, 30)).save(out, "PNG", pnginfo=note)
    assert len(out.getvalue()) < 1_000_000
    with pytest.raises(InputError) as caught:
        decode_upright(out.getvalue(), "a", BOUNDS)
    assert caught.value.reason == "unreadable_color"
