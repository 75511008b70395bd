"""Vertex colours as a texture: MuJoCo, like most simulators, does not look at colours of vertices.

A face gets one colour, and all its corners the same point of the texture: no colour bleeds into another whatever
the filter or the distance, and equal colours share a texel, so the file stays small.
"""

import io

import numpy as np
from PIL import Image

from schemas.geometry import TriangleMesh
from tableverse_factory.physics.assets import Appearance

MAX_SIDE = 256


def bake(mesh: TriangleMesh) -> Appearance | None:
    """The mesh's vertex colours, averaged over each face, as a texture of at most 256 × 256; None where it has none."""
    if mesh.vertex_colors is None:
        return None
    mixed = np.rint(mesh.vertex_colors[mesh.faces].astype(np.float64).mean(axis=1)).astype(np.uint8)
    colors, texel = _distinct(mixed)
    side = int(np.ceil(np.sqrt(len(colors))))
    picture = np.zeros((side * side, 3), dtype=np.uint8)
    picture[: len(colors)] = colors
    picture[len(colors) :] = colors[-1]
    row, column = np.divmod(texel, side)
    # The v axis of an OBJ points up, the rows of a picture go down.
    uv = np.stack([(column + 0.5) / side, 1.0 - (row + 0.5) / side], axis=1)
    return Appearance(_png(picture.reshape(side, side, 3)), uv)


def _distinct(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sorted distinct colours and the index of each; coarser by a bit at a time until they fit the texture."""
    for shift in range(8):
        coarse = (colors >> shift << shift) + ((1 << shift) >> 1)
        found, index = np.unique(coarse.astype(np.uint8), axis=0, return_inverse=True)
        if len(found) <= MAX_SIDE * MAX_SIDE:
            break
    return found, index.reshape(-1)


def _png(picture: np.ndarray) -> bytes:
    out = io.BytesIO()
    Image.fromarray(picture).save(out, "PNG", compress_level=6)
    return out.getvalue()
