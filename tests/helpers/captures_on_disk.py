"""Small captures, layouts and pictures on disk, sound ones and hostile ones."""

import json
import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

CAMERA = {"fx": 30.0, "fy": 30.0, "cx": 16.0, "cy": 12.0, "width": 32, "height": 24, "depth_scale": 0.001}
MESH = b"v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def write_picture(path: Path, seed: int, size=(24, 32)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 255, (*size, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)
    return path


def write_capture(folder: Path, seed: int, depth=None, **camera) -> Path:
    write_picture(folder / "color.png", seed)
    depth = np.full((24, 32), 800, np.uint16) if depth is None else depth
    Image.fromarray(depth).save(folder / "depth.png")
    (folder / "camera.json").write_text(json.dumps({**CAMERA, **camera}))
    return folder


def write_layout(path: Path, mesh="mug.obj", content=MESH, **changes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    if content is not None:
        (path.parent / "mug.obj").write_bytes(content)
    pose = {"position": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0]}
    entry = {"id": "obj_000", "label": "mug", "mesh": mesh, "pose": pose, **changes}
    path.write_text(json.dumps({"frame": "table", "objects": [entry]}))
    return path


def huge_png(width: int, height: int) -> bytes:
    """A sound header of a picture that nobody should decode."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"\0" * 9999))
        + chunk(b"IEND", b"")
    )
