"""Disk cache of convex pieces by the content of the shape; shared between processes, safe to delete at any time."""

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

VERSION = b"pieces 5"  # changes whenever the same shape and parameters would give other pieces
_PACKAGES = ("coacd", "manifold3d", "numpy", "scipy")  # their versions may change the pieces of the same shape


class PieceCache:
    """Pieces of shapes of extent 1, a file each (`schemas.codec`)."""

    def __init__(self, folder: Path, config: RectifyConfig) -> None:
        self._files = DiskCache(folder / "pieces", ".arrow")
        settings = f"{config.decomposition} {config.volume_error!r} {config.max_pieces}"
        self._parameters = f"{settings} {_get_versions()}".encode()

    def key(self, shape: TriangleMesh) -> str:
        """Hash the triangles and the parameters."""
        vertices = (shape.vertices + 0.0).astype("<f8")  # no negative zeros
        faces = shape.faces.astype("<i4")
        return content_hash(VERSION, self._parameters, vertices.tobytes(), np.ascontiguousarray(faces).tobytes())

    def get(self, key: str) -> ConvexPieces | None:
        """Return the pieces stored under a key; None where there are none, or the file is damaged."""
        payload = self._files.get(key)
        if payload is None:
            return None
        try:
            record = decode(payload)
        except (ValueError, TypeError, KeyError, pa.ArrowInvalid):  # written by another version of the records
            return None
        return record if isinstance(record, ConvexPieces) else None

    def put(self, key: str, pieces: ConvexPieces) -> None:
        """Store pieces, as far as the disk allows: an unwritable cache costs time, but no scene."""
        with suppress(OSError):
            self._files.put(key, encode(pieces))


@cache
def _get_versions() -> str:
    """Versions of the packages; cached, as each look-up takes 10 ms."""
    return " ".join(version(name) for name in _PACKAGES)
