"""Mesh files of a scene: OBJ text with fixed decimals, so that equal meshes give equal bytes everywhere."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Frozen, TriangleMesh
from tableverse_factory.errors import GeometryError
from tableverse_factory.geometry.boxes import size_around
from tableverse_factory.geometry.hulls import outward_faces
from tableverse_factory.physics.digits import lines_of_decimals, lines_of_integers

MAX_PIECE_VERTICES = 64
MIN_MESH_VERTICES = 4
MIN_PIECE_THICKNESS_M = 5e-5
"""Thinner convex pieces carry nothing in a simulation and make MuJoCo's own hull fail."""


@dataclass(frozen=True, slots=True, eq=False)
class Appearance(Frozen):
    """Colours of a mesh as a texture.

    Attributes:
        texture_png: The file.
        corner_uv: Points of the texture at each face's corners. Shape (m, 3, 2), v upwards.
    """

    texture_png: bytes
    corner_uv: Float64[np.ndarray, "m 3 2"]


def scaled(mesh: TriangleMesh, scale: float) -> TriangleMesh:
    """The mesh in metres, rounded to what its file will say; the certificate then measures what is in the file.

    A lone triangle gets a fourth vertex in its middle, which no face uses: MuJoCo reads no mesh of three.
    """
    vertices = mesh.vertices * scale
    colors = mesh.vertex_colors
    if len(vertices) < MIN_MESH_VERTICES:
        vertices = np.concatenate([vertices, vertices.mean(axis=0, keepdims=True)])
        colors = None if colors is None else np.concatenate([colors, colors[:1]])
    return replace(mesh, vertices=np.round(vertices, decimals(vertices)) + 0.0, vertex_colors=colors)


def decimals(vertices: np.ndarray) -> int:
    """Digits after the point: a tenth of a micrometre, and finer for things under a centimetre."""
    extent = float(size_around(vertices).max())
    return 7 + max(0, int(np.ceil(-2 - np.log10(max(extent, 1e-9)))))


def obj_bytes(mesh: TriangleMesh, appearance: Appearance | None = None) -> bytes:
    """An OBJ file of a mesh that `scaled` made."""
    text = lines_of_decimals(b"v ", mesh.vertices, decimals(mesh.vertices), b"  \n")
    corners = mesh.faces.astype(np.int64) + 1
    if appearance is None:
        return text + lines_of_integers(b"f ", corners, b"  \n")
    uv, index = _distinct(appearance.corner_uv.reshape(-1, 2))
    table = np.stack([corners.reshape(-1), index + 1], axis=1).reshape(-1, 6)
    return text + lines_of_decimals(b"vt ", uv, 6, b" \n") + lines_of_integers(b"f ", table, b"/ / /\n")


def _distinct(points: Float64[np.ndarray, "n 2"]) -> tuple[Float64[np.ndarray, "k 2"], Int64[np.ndarray, " n"]]:
    """The points in order, each once, and the index of each; coordinate by coordinate, which sorts numbers only."""
    (u, column), (v, row) = (np.unique(points[:, axis], return_inverse=True) for axis in (0, 1))
    pair, index = np.unique(column * len(v) + row, return_inverse=True)
    return np.stack([u[pair // len(v)], v[pair % len(v)]], axis=1), index


def usable_hulls(hulls: tuple[TriangleMesh, ...], scale: float) -> tuple[TriangleMesh, ...]:
    """Scaled convex pieces, rounded and then made convex again, without those too thin to simulate.

    Raises:
        GeometryError: if nothing is left, or a piece has more vertices than MuJoCo's fast path takes.
    """
    kept = []
    for hull in hulls:
        piece = _convex(scaled(hull, scale).vertices) if len(hull.vertices) >= 4 else None
        if piece is not None and len(piece.vertices) > MAX_PIECE_VERTICES:
            raise GeometryError(f"a convex piece has {len(piece.vertices)} vertices; at most {MAX_PIECE_VERTICES}")
        if piece is not None:
            kept.append(piece)
    if not kept:
        raise GeometryError(
            f"none of {len(hulls)} convex pieces is {MIN_PIECE_THICKNESS_M * 1e3:g} mm thick: too small or too flat"
        )
    return tuple(kept)


def _convex(points: np.ndarray) -> TriangleMesh | None:
    """The hull of the points, or None where it is flatter than `MIN_PIECE_THICKNESS_M`."""
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    if 2 * hull.volume < MIN_PIECE_THICKNESS_M * hull.area:
        return None
    return TriangleMesh(*outward_faces(hull))
