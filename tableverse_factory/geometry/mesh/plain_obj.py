"""Fast reader for plain OBJ files: vertices, then triangles; all others are left to a general reader."""

import numpy as np
import pyarrow as pa
from jaxtyping import Float64
from pyarrow import csv

from schemas.geometry import TriangleMesh

CornerUv = Float64[np.ndarray, "m 3 2"]

_PLAIN = b"0123456789.+-e vf\r\n"
_NO_INDEX = (b".", b"e")
_MOST_NUMBERS = 6
_FEW_BYTES = 50_000  # below it numpy is faster than Arrow: pieces are read by the thousand
_LARGEST = 1e9  # no arithmetic overflows below it


def read_plain_obj(data: bytes) -> TriangleMesh | None:
    """Read a file of lines `v x y z` or `v x y z r g b`, then lines `f i j k`, and nothing else.

    Colours are sRGB, 0 to 1. None for any other file, and where a vertex belongs to no face or a number is huge.
    """
    first_face = data.find(b"\nf ")
    if first_face < 0 or data.translate(None, _PLAIN):
        return None
    corners = data[first_face + 1 :]
    if any(part in corners for part in _NO_INDEX):
        return None
    vertices, faces = _table(data[:first_face], b"v", pa.float64()), _table(corners, b"f", pa.int64())
    if vertices is None or faces is None or vertices.shape[1] not in (3, 6) or faces.shape[1] != 3:
        return None
    if np.abs(vertices).max() > _LARGEST or faces.min() < 1 or faces.max() > len(vertices):
        return None
    indices, used = (faces - 1).astype(np.int32), np.zeros(len(vertices), dtype=bool)
    used[indices] = True
    if not used.all():  # the general reader drops the others, and boxes depend on them
        return None
    colors = None
    if vertices.shape[1] == 6:
        colors = (255.0 * np.clip(vertices[:, 3:], 0.0, 1.0)).round().astype(np.uint8)
    return TriangleMesh(vertices[:, :3].copy(), indices, colors)


def read_textured_obj(data: bytes) -> tuple[TriangleMesh, CornerUv] | None:
    """Read a file of lines `v x y z`, `vt u v` and `f i/k j/l m/n`, in this order, as scenes are exported.

    Also returns the texture coordinates at each face's corners. None for any other file.
    """
    first_uv, first_face = data.find(b"\nvt "), data.find(b"\nf ")
    if not 0 <= first_uv < first_face:
        return None
    corners = data[first_face + 1 :].replace(b"/", b" ")
    points = _table(data[first_uv + 1 : first_face].replace(b"vt", b"v"), b"v", pa.float64())
    table = _table(corners, b"f", pa.int64())
    if points is None or table is None or points.shape[1] != 2 or table.shape[1] != 6:
        return None
    vertices = _table(data[:first_uv], b"v", pa.float64())
    if vertices is None or vertices.shape[1] != 3 or table.min() < 1:
        return None
    faces, uv = (table[:, ::2] - 1).astype(np.int32), (table[:, 1::2] - 1).astype(np.int64)
    if np.abs(vertices).max() > _LARGEST or faces.max() >= len(vertices) or uv.max() >= len(points):
        return None
    return TriangleMesh(vertices.copy(), faces), np.clip(points, 0.0, 1.0)[uv]


def _table(text: bytes, letter: bytes, kind: pa.DataType) -> np.ndarray | None:
    """Parse the numbers after the letter of each line, as many in each; None where a line is anything else.

    Arrow reads many numbers in half of numpy's time, but takes longer to start.
    """
    lines = text.count(b"\n") + (not text.endswith(b"\n"))
    if not lines == text.count(letter) == (b"\n" + text).count(b"\n" + letter + b" "):
        return None
    try:
        if len(text) >= _FEW_BYTES:
            return _by_arrow(text, kind)
        rows = text.replace(letter, b"").decode("ascii").splitlines()
        return np.loadtxt(rows, dtype=np.float64, comments=None, ndmin=2)
    except ValueError:  # Arrow's errors are ValueErrors too
        return None


def _by_arrow(text: bytes, kind: pa.DataType) -> np.ndarray | None:
    count = text.partition(b"\n")[0].rstrip(b"\r").count(b" ")
    if count > _MOST_NUMBERS:
        return None
    names = [str(column) for column in range(count + 1)]
    table = csv.read_csv(
        pa.py_buffer(text),
        csv.ReadOptions(use_threads=False, block_size=len(text) + 1, column_names=names),
        csv.ParseOptions(delimiter=" ", quote_char=False, double_quote=False),
        csv.ConvertOptions(
            include_columns=names[1:], column_types=dict.fromkeys(names[1:], kind), null_values=[], check_utf8=False
        ),
    )
    return np.stack([column.to_numpy() for column in table.columns], axis=1)
