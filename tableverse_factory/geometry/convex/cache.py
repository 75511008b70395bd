"""Convex pieces on disk, by the content of the shape. Safe to share between processes, and to delete at any time."""

from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pyarrow as pa

from schemas.codec import decode, encode
from schemas.config import RectifyConfig
from schemas.geometry import ConvexPieces, TriangleMesh
from schemas.identity import content_hash
from tableverse_factory.core.disk_cache import DiskCache

VERSION = b"pieces 5"
"""Changes whenever the same shape and parameters would give other pieces."""
_DECIDING = ("coacd", "manifold3d", "numpy", "scipy")
"""Packages whose versions may change the pieces of the same shape."""


class PieceCache:
    """Pieces of shapes about 1 large, a file each (`schemas.codec`)."""

    def __init__(self, folder: Path, config: RectifyConfig) -> None:
        self._files = DiskCache(folder / "pieces", ".arrow")
        self._parameters = f"{config.decomposition} {config.volume_error!r} {config.max_pieces} {_versions()}".encode()

    def key(self, shape: TriangleMesh) -> str:
        """Hash of what decides the pieces: the triangles and the parameters."""
        vertices = (shape.vertices + 0.0).astype("<f8")  # no negative zeros
        faces = shape.faces.astype("<i4")
        return content_hash(VERSION, self._parameters, vertices.tobytes(), np.ascontiguousarray(faces).tobytes())

    def get(self, key: str) -> ConvexPieces | None:
        """The pieces stored under a key; None where there are none, or the file is damaged."""
        payload = self._files.get(key)
        if payload is None:
            return None
        try:
            record = decode(payload)
        except (ValueError, TypeError, KeyError, pa.ArrowInvalid):  # written by another version of the records
            return None
        return record if isinstance(record, ConvexPieces) else None

    def put(self, key: str, pieces: ConvexPieces) -> None:
        """Stores pieces. A cache that cannot be written (full, read-only, deleted meanwhile) costs time, no scene."""
        with suppress(OSError):
            self._files.put(key, encode(pieces))


@cache
def _versions() -> str:
    """Of the packages that decide; they do not change while a process runs, and looking costs 10 ms each."""
    return " ".join(version(name) for name in _DECIDING)
