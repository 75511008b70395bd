"""The plainest OBJ files, vertices and then triangles, read at once; all others are left to a reader of the format."""

import numpy as np
import pyarrow as pa
from pyarrow import csv

from schemas.geometry import Faces, TriangleMesh

_PLAIN = b"0123456789.+-e vf\r\n"
_MOST_NUMBERS = 6
_LARGEST = 1e9
"""No mesh of ours has greater numbers, and no arithmetic overflows below."""


def read_plain_obj(data: bytes) -> TriangleMesh | None:
    """The mesh of a file of lines `v x y z` or `v x y z r g b`, then lines `f i j k`, and nothing else.

    Colours are sRGB, 0 to 1. None for any other file, and where a vertex belongs to no face or a number is huge.
    """
    first_face = data.find(b"\nf ")
    if first_face < 0 or data.translate(None, _PLAIN):
        return None
    vertices, faces = _table(data[:first_face], "v", pa.float64()), _table(data[first_face + 1 :], "f", pa.int64())
    if vertices is None or faces is None or vertices.shape[1] not in (3, 6) or faces.shape[1] != 3:
        return None
    if np.abs(vertices).max() > _LARGEST or faces.min() < 1 or faces.max() > len(vertices):
        return None
    indices = (faces - 1).astype(np.int32)
    if not _all_used(indices, len(vertices)):
        return None
    colors = None
    if vertices.shape[1] == 6:
        colors = (255.0 * np.clip(vertices[:, 3:], 0.0, 1.0)).round().astype(np.uint8)
    return TriangleMesh(vertices[:, :3].copy(), indices, colors)


def _all_used(faces: Faces, count: int) -> bool:
    """Whether every vertex is a corner of a face: the slow reader drops the others, and boxes depend on them."""
    used = np.zeros(count, dtype=bool)
    used[faces] = True
    return bool(used.all())


def _table(text: bytes, letter: str, kind: pa.DataType) -> np.ndarray | None:
    """The numbers after the letter of each line, as many in each; None where a line is anything else.

    A table of words with a blank between them is a CSV file to Arrow, which reads numbers five times faster than numpy.
    """
    names = [letter, *map(str, range(text.partition(b"\n")[0].count(b" ")))]
    if not 1 < len(names) <= _MOST_NUMBERS + 1:
        return None
    types = {name: pa.string() if name == letter else kind for name in names}
    try:
        table = csv.read_csv(
            pa.py_buffer(text),
            csv.ReadOptions(use_threads=False, block_size=len(text) + 1, column_names=names),
            csv.ParseOptions(delimiter=" ", quote_char=False, double_quote=False),
            csv.ConvertOptions(column_types=types, null_values=[], check_utf8=False),
        )
    except pa.ArrowInvalid:
        return None
    if table.column(letter).unique().to_pylist() != [letter]:
        return None
    return np.stack([table.column(name).to_numpy() for name in names[1:]], axis=1)
