"""The focal length of a bare picture: by its EXIF where it can be believed, else as configured, else the usual one."""

import io
import json
import struct

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from schemas.config import ObserveConfig
from tableverse_factory.core.errors import InputError
from tableverse_factory.sources.focal import LONGEST, SHORTEST, read_exif_focal
from tableverse_factory.sources.manifest import make_manifest
from tableverse_factory.stages.observe.depth.rgb_image import MAX_SIDE_PX, read_rgb_image

BOUNDS = ObserveConfig()
# A sheet 0.7 m away, seen by a camera of 350 px at 400 x 300 pixels, in a file five times as large
SHEET = {"kind": "a4", "pixels": [[782.7, 1119.6], [1539.2, 891.0], [1289.8, 563.4], [652.6, 716.5]]}


def choose(path, focal_px=None, known_length=""):
    return read_rgb_image(str(path), BOUNDS).choose_focal(focal_px, known_length)


EXIF_IFD, MM, MM_35, WIDTH, HEIGHT, PER_UNIT, UNIT = 0x8769, 0x920A, 0xA405, 0xA002, 0xA003, 0xA20E, 0xA210
ORIENTATION = 0x0112


def jpeg(size=(400, 300), orientation=None, **tags):
    names = {"mm": MM, "mm_35": MM_35, "width": WIDTH, "height": HEIGHT, "per_unit": PER_UNIT, "unit": UNIT}
    exif = Image.Exif()
    if orientation:
        exif[ORIENTATION] = orientation
    exif.get_ifd(EXIF_IFD).update({names[name]: value for name, value in tags.items()})
    out = io.BytesIO()
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    pixels[: size[1] // 2, : size[0] // 2] = 255  # the upper left quarter, as the file has it
    Image.fromarray(pixels).save(out, "JPEG", exif=exif, quality=95)
    return out.getvalue()


def focal(**given):
    return read_exif_focal(Image.open(io.BytesIO(jpeg(**given)))).px


def ignored(**given):
    found = read_exif_focal(Image.open(io.BytesIO(jpeg(**given))))
    assert found.px is None
    return found.ignored


def test_by_the_equivalent_on_film():
    assert focal(size=(3600, 2400), mm_35=50) == pytest.approx(5000.0)
    assert focal(size=(400, 300), mm_35=26) == pytest.approx(26 * 500 / 43.2666, rel=1e-4)


def test_by_millimetres_and_the_sensor_at_the_size_it_was_taken_and_any_smaller():
    taken = {"mm": IFDRational(40, 10), "per_unit": 5000.0, "unit": 3, "width": 4000, "height": 3000}
    assert focal(size=(4000, 3000), **taken) == pytest.approx(4.0 * 500)
    assert focal(size=(400, 300), **taken) == pytest.approx(200.0)
    assert focal(size=(300, 400), **taken) == pytest.approx(200.0), "turned by whoever made it smaller"


SENSOR = {"per_unit": 5000.0, "unit": 3, "width": 4000, "height": 3000}


@pytest.mark.parametrize(
    "told",
    [
        {"mm": 4.0},
        {"mm_35": 60000},
        {"mm_35": 1},
        {"mm": 4.0, "per_unit": 500.0, "unit": 3},
        {"mm": 4.0, **SENSOR, "unit": 9},
        {"mm": 4.0, **SENSOR, "per_unit": 0.0},
        {"mm": 4.0, **SENSOR, "per_unit": -500.0},
        {"mm": IFDRational(4, 0), **SENSOR},
        {"mm": IFDRational(0, 1), **SENSOR},
        {"mm": -4.0, **SENSOR},
        {"mm": float("nan"), **SENSOR},
        {"mm": 1e9, **SENSOR},
    ],
    ids=str,
)
def test_what_cannot_be_believed_is_ignored_with_a_note(told):
    assert ignored(**told) == "EXIF focal length that cannot be used"


@pytest.mark.parametrize("told", [{}, {"mm_35": 0}, SENSOR], ids=str)
def test_a_picture_that_tells_no_focal_length_has_nothing_to_note(told):
    assert not ignored(**told)


def test_the_focal_length_of_what_was_cropped_since_is_ignored():
    assert ignored(mm_35=26, width=4000, height=2000) == "EXIF focal length of a picture that was cropped since"


def test_an_absurd_equivalent_leaves_the_sensors_own_length():
    assert focal(mm_35=60000, mm=4.0, **SENSOR) == pytest.approx(200.0)


def with_exif(exif, kind="PNG"):
    out = io.BytesIO()
    Image.new("RGB", (40, 30)).save(out, kind, exif=exif)
    return out.getvalue()


def link(kind, value, behind=bytes(24)):
    """EXIF whose only entry says where the camera's entries lie."""
    return with_exif(struct.pack("<4sIHHHIII", b"II*\0", 8, 1, EXIF_IFD, kind, 1, value, 0) + behind)


BROKEN = {
    SyntaxError: with_exif(b"no TIFF at all"),
    struct.error: with_exif(b"MM\0*"),
    ValueError: link(9, 2**32 - 1),
    OverflowError: link(16, 26, b"\xaa" * 24),
    OSError: with_exif(None)[:60],
}


@pytest.mark.parametrize(("raised", "data"), BROKEN.items(), ids=lambda part: getattr(part, "__name__", ""))
def test_whatever_pillow_raises_about_broken_exif_is_no_focal_length(raised, data):
    with pytest.raises(raised):
        Image.open(io.BytesIO(data)).getexif().get_ifd(EXIF_IFD)
    assert read_exif_focal(Image.open(io.BytesIO(data))).px is None


def exif_of(told) -> bytes:
    data = jpeg(**told)
    return data[data.index(b"Exif\0\0") + 6 :][:200].split(b"\xff\xdb")[0]


SOUND = exif_of({"mm_35": 26, "mm": 4.0, "per_unit": 500.0, "unit": 3, "width": 4000, "height": 3000})
CHANGES = st.lists(st.tuples(st.integers(4, len(SOUND) - 1), st.integers(0, 255)), max_size=6)


@example(changes=[], kept=len(SOUND), kind="PNG")
@example(changes=[], kept=len(SOUND) - 9, kind="PNG")
@settings(max_examples=50)
@given(CHANGES, st.integers(8, len(SOUND)), st.sampled_from(["WEBP", "PNG"]))
def test_exif_that_was_changed_or_cut_gives_a_believable_length_or_none(changes, kept, kind):
    exif = bytearray(SOUND)
    for place, value in changes:
        exif[place] = value
    found = read_exif_focal(Image.open(io.BytesIO(with_exif(b"Exif\0\0" + bytes(exif[:kept]), kind)))).px
    assert found is None or SHORTEST * 40 <= found <= LONGEST * 40
    if not changes and kept == len(SOUND):
        assert found == pytest.approx(26 * 50 / 43.2666, rel=1e-4)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_picture_stands_upright_and_keeps_its_focal_length(tmp_path, orientation):
    path = tmp_path / "photo.jpg"
    path.write_bytes(jpeg(orientation=orientation, mm_35=26))
    photo = read_rgb_image(str(path), BOUNDS)
    assert photo.color.shape == ((300, 400, 3) if orientation < 5 else (400, 300, 3))
    assert photo.exif_px == pytest.approx(26 * 500 / 43.2666, rel=1e-4)


def test_a_large_picture_is_made_smaller_and_its_focal_length_with_it(tmp_path):
    path = tmp_path / "photo.jpg"
    path.write_bytes(jpeg(size=(4096, 1024), mm_35=50))
    photo = read_rgb_image(str(path), BOUNDS)
    assert photo.color.shape == (512, MAX_SIDE_PX, 3)
    assert photo.exif_px == pytest.approx(50 * np.hypot(4096, 1024) / 43.2666 / 2, rel=1e-4)
    path.write_bytes(jpeg(size=(4096, 1024)))
    assert choose(path, 3000.0).px == pytest.approx(1500.0)


def test_exif_goes_before_what_is_configured_for_all_and_that_before_the_usual_angle(tmp_path):
    path = tmp_path / "photo.jpg"
    path.write_bytes(jpeg(mm_35=26))
    focal = choose(path, 1234.0)
    assert (focal.px, focal.source) == (pytest.approx(300.46, rel=1e-3), "exif")
    path.write_bytes(jpeg())
    focal = choose(path, 1234.0)
    assert (focal.px, focal.source) == (1234.0, "assumed")


def test_a_sheet_tells_what_neither_file_nor_configuration_do(tmp_path):
    path, known = tmp_path / "photo.jpg", json.dumps(SHEET)
    path.write_bytes(jpeg(size=(2000, 1500)))
    told = choose(path, None, known)
    assert (told.px, told.source) == (pytest.approx(1750.0, rel=0.03), "sheet")
    assert 0.0 < told.sigma < 0.1
    assert choose(path, 2000.0, known).source == "assumed"
    path.write_bytes(jpeg(size=(4000, 3000)))  # read at half of its size
    twice = json.dumps({**SHEET, "pixels": [[2 * x + 0.5, 2 * y + 0.5] for x, y in SHEET["pixels"]]})
    assert choose(path, None, twice).px == pytest.approx(1.024 * told.px, rel=0.01)
    path.write_bytes(jpeg(size=(2000, 1500), mm_35=26))
    assert choose(path, None, known).source == "exif"


def test_corners_outside_of_the_picture_are_refused(tmp_path):
    path = tmp_path / "photo.jpg"
    path.write_bytes(jpeg())
    with pytest.raises(InputError, match="lies outside: the upright picture has 400 x 300") as caught:
        choose(path, None, json.dumps(SHEET))
    assert caught.value.reason == "bad_known_length"


@pytest.mark.parametrize("focal_px", [1.0, 1e6])
def test_a_focal_length_that_no_camera_has_is_refused_by_its_name(tmp_path, focal_px):
    path = tmp_path / "photo.jpg"
    path.write_bytes(jpeg())
    with pytest.raises(InputError, match=r"observe\.focal_px: fx = .* give pixels, for 1° to 160°") as caught:
        choose(path, focal_px)
    assert caught.value.reason == "bad_intrinsics"


@pytest.mark.parametrize("orientation", [1, 6])
def test_without_any_focal_length_the_longer_side_shows_58_degrees(tmp_path, orientation):
    path = tmp_path / "photo.jpg"
    path.write_bytes(jpeg(orientation=orientation))
    focal_px = choose(path).px
    assert np.degrees(2 * np.arctan(200.0 / focal_px)) == pytest.approx(58.0)


def test_the_manifest_counts_the_focal_lengths_that_it_ignores(tmp_path):
    for name, told in (("a", {"mm_35": 26}), ("b", {"mm_35": 60000}), ("c", {"mm": float("nan"), **SENSOR}), ("d", {})):
        (tmp_path / f"{name}.jpg").write_bytes(jpeg(**told))
    made = make_manifest([str(tmp_path)], BOUNDS)
    assert [row.rejected for row in made.rows] == [""] * 4
    assert made.ignored == {"EXIF focal length that cannot be used": 2}
