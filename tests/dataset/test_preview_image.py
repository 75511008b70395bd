"""What a scene's folder claims to be a photograph or a pose: shown, or refused in one line."""

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.preview_image import read_photograph
from tableverse_factory.dataset.scene_meta import read_meta_pose


def encoded(width: int, height: int, kind: str = "JPEG") -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (width, height), (120, 130, 140)).save(file, kind)
    return file.getvalue()


def claimed(width: int, height: int) -> bytes:
    """A PNG whose header promises so many pixels."""
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))


@pytest.mark.parametrize(("given", "shown"), [((3000, 2000), (640, 427)), ((640, 480), (640, 480)), ((9, 6), (9, 6))])
def test_a_photograph_is_at_most_as_wide_as_asked(given, shown):
    picture = read_photograph(encoded(*given), "photo", 640)
    assert (picture.size, picture.mode) == (shown, "RGB")
    assert np.abs(np.asarray(picture).astype(int) - [120, 130, 140]).max() < 4


@pytest.mark.parametrize(
    "data",
    [
        claimed(60_000, 60_000),
        claimed(12_000, 12_000),
        claimed(100, 100),
        encoded(4, 700),
        encoded(3, 9000, "PNG"),
        encoded(640, 480)[:900],
        b"",
        b"GIF89a",
    ],
)
def test_what_is_no_photograph_is_refused_in_words(data):
    with pytest.raises(InputError, match="photo of a"):
        read_photograph(data, "photo of a", 640)


@pytest.mark.parametrize(
    "value",
    [
        None,
        3,
        {},
        {"position": [0, 0], "quaternion_wxyz": [1, 0, 0, 0]},
        {"position": [0, 0, 10**400], "quaternion_wxyz": [1, 0, 0, 0]},
        {"position": [0, 0, float("nan")], "quaternion_wxyz": [1, 0, 0, 0]},
        {"position": [0, 0, 2e3], "quaternion_wxyz": [1, 0, 0, 0]},
        {"position": [0, 0, 0], "quaternion_wxyz": [0, 0, 0, 0]},
    ],
)
def test_a_pose_that_is_none_is_refused_in_words(value):
    with pytest.raises(InputError, match=r"meta.json: a pose of obj_000 makes no sense") as told:
        read_meta_pose(value, "obj_000")
    assert told.value.reason == "bad_meta"
