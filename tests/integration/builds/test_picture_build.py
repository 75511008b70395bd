"""Bare pictures through `manifest` and `build`: a table is done, and every file that is none is a row with a reason."""

import io
import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import skimage
from PIL import Image

from tableverse_factory.dataset.dataset import open_dataset
from tests.helpers.tabletop_views import Box, look

THINGS = (Box(-0.12, 0.05, (0.1, 0.06, 0.15)), Box(0.15, -0.05, (0.08, 0.08, 0.08), color=(40, 90, 200)))
DATA = Path(skimage.__file__).parent / "data"


def encode(image: Image.Image, form: str, **options: object) -> bytes:
    out = io.BytesIO()
    image.save(out, form, **options)
    return out.getvalue()


def declare_png(width: int, height: int) -> bytes:
    """The head of a PNG, and no pixels worth naming."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def write_pictures(folder: Path) -> None:
    """A table, and what cannot be read as one picture."""
    folder.mkdir()
    image = Image.fromarray(look(THINGS, floor_z=-0.7, wall_y=1.5)[0].color)
    frames = {"save_all": True, "append_images": [image.transpose(Image.Transpose.FLIP_LEFT_RIGHT)]}
    marked = image.copy()
    marked.putpixel((0, 0), (1, 2, 3))
    known = {"known_length": {"kind": "camera_height", "length_m": 2.2}}  # it is 0.6
    small = np.full((8, 8, 3), 90, np.uint8)
    files = {
        "table.png": encode(image, "PNG"),
        "mistaken.png": encode(marked, "PNG"),
        "mistaken.source.json": json.dumps(known).encode(),
        "truncated.png": encode(image, "PNG")[:2000],
        "truncated.jpg": encode(image, "JPEG")[:4000],
        "enormous.png": declare_png(60_000, 60_000),
        "animated.png": encode(image, "PNG", **frames),
        "animated.webp": encode(image, "WEBP", **frames),
        "gif.jpg": encode(image, "GIF", **frames),
        "other.gif": encode(image, "GIF", **frames),
        "rocket.jpg": (DATA / "rocket.jpg").read_bytes(),
        "strip.png": encode(image.resize((3000, 100)), "PNG"),
        "photo.HEIC": b"\0\0\0\x18ftypheic",
        "tiny.png": encode(Image.fromarray(small), "PNG"),
        "empty.png": b"",
    }
    for name, data in files.items():
        (folder / name).write_bytes(data)


@pytest.mark.slow
def test_every_file_becomes_a_row(tmp_path, run) -> None:
    write_pictures(tmp_path / "in")
    code, said, errors = run("manifest", tmp_path / "in", "--out", tmp_path / "m.parquet")
    assert code == 0, said + errors
    assert "left alone" not in said
    out = tmp_path / "out"
    code, said, errors = run("build", tmp_path / "m.parquet", out, "--executor", "local", "--workers", 1)
    assert code == 0, said + errors
    rows = {row["uri"].split("/")[-1]: row for row in open_dataset(out).scenes.to_table().to_pylist()}
    told = {name: row["reason"] or row["status"] for name, row in rows.items()}
    assert told == {
        "table.png": "done",
        "mistaken.png": "done",
        "truncated.png": "unreadable_color",
        "truncated.jpg": "unreadable_color",
        "empty.png": "unreadable_color",
        "enormous.png": "picture_too_large",
        "animated.png": "animated_picture",
        "animated.webp": "animated_picture",
        "gif.jpg": "unreadable_color",
        "rocket.jpg": "no_table",
        "tiny.png": "picture_too_small",
        "strip.png": "picture_too_narrow",
        "other.gif": "unsupported_format",
        "photo.HEIC": "unsupported_format",
    }
    table = rows["table.png"]
    assert (table["scale_source"], table["intrinsics_source"]) == ("estimated", "assumed")
    assert table["field_of_view_deg"] == pytest.approx(58.0)
    assert table["scale_sigma"] > 0
    assert table["scale_deviation"] is None
    mistaken = rows["mistaken.png"]
    assert mistaken["scale_source"] == "measured"
    assert mistaken["scale_deviation"] > 3
    shown = run("status", out)[1]
    assert f"check it: 1 scene ({mistaken['scene_id']})" in shown
    assert f"usable: {table['usable'] + mistaken['usable']} of 2 scenes" in shown
    code, said, errors = run("verify", out)
    assert code == 0, said + errors
