"""Mesh files of a scene: OBJ text with fixed decimals, so that equal meshes give equal bytes everywhere."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from schemas.geometry import Frozen, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.aabb import size_around
from tableverse_factory.geometry.mesh.hulls import face_heights, hull_mesh
from tableverse_factory.geometry.mesh.mass_integrals import signed_volume
from tableverse_factory.geometry.mesh.surface_samples import surface_area
from tableverse_factory.physics.mjcf.fast_text import lines_of_decimals, lines_of_integers

MAX_PIECE_VERTICES = 64
MIN_MESH_VERTICES = 4
MIN_PIECE_THICKNESS_M = 5e-5
"""Thinner convex pieces carry nothing in a simulation and make MuJoCo's own hull fail."""

LAST_DIGITS = 4
"""Units of the last digit: how far rounding may move a corner over the plane of a face that is not much longer than
wide."""


@dataclass(frozen=True, slots=True, eq=False)
class Appearance(Frozen):
    """Colours of a mesh as a texture.

    Attributes:
        texture_png: The file.
        points: Points of the texture, each once. Shape (k, 2), v upwards.
        corners: Which of them each face's corners have. Shape (m, 3).
    """

    texture_png: bytes
    points: Float64[np.ndarray, "k 2"]
    corners: Int64[np.ndarray, "m 3"]

    @classmethod
    def at_corners(cls, texture_png: bytes, corner_uv: Float64[np.ndarray, "m 3 2"]) -> "Appearance":
        """The same from the point at each face's corners."""
        points, index = _distinct(corner_uv.reshape(-1, 2))
        return cls(texture_png, points, index.reshape(-1, 3))

    @property
    def corner_uv(self) -> Float64[np.ndarray, "m 3 2"]:
        """The point of the texture at each face's corners."""
        uv: Float64[np.ndarray, "m 3 2"] = self.points[self.corners]
        return uv


def scale_and_quantize(mesh: TriangleMesh, scale: float) -> TriangleMesh:
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
    table = np.stack([corners, appearance.corners + 1], axis=2).reshape(-1, 6)
    points = lines_of_decimals(b"vt ", appearance.points, 6, b" \n")
    return text + points + lines_of_integers(b"f ", table, b"/ / /\n")


def _distinct(points: Float64[np.ndarray, "n 2"]) -> tuple[Float64[np.ndarray, "k 2"], Int64[np.ndarray, " n"]]:
    """The points in order, each once, and the index of each; coordinate by coordinate, which sorts numbers only."""
    (u, column), (v, row) = (np.unique(points[:, axis], return_inverse=True) for axis in (0, 1))
    pair, index = np.unique(column * len(v) + row, return_inverse=True)
    return np.stack([u[pair // len(v)], v[pair % len(v)]], axis=1), index


def usable_hulls(hulls: tuple[TriangleMesh, ...], scale: float) -> tuple[TriangleMesh, ...]:
    """Scaled convex pieces, rounded to what their files will say, without those too thin to simulate.

    A piece that rounding has dented by more than its last digits is made convex again.

    Raises:
        GeometryError: if nothing is left, or a piece has more vertices than MuJoCo's fast path takes.
    """
    kept = []
    for hull in hulls:
        piece = _thick(scale_and_quantize(hull, scale)) if len(hull.vertices) >= 4 else None
        if piece is not None and len(piece.vertices) > MAX_PIECE_VERTICES:
            raise GeometryError(f"a convex piece has {len(piece.vertices)} vertices; at most {MAX_PIECE_VERTICES}")
        if piece is not None:
            kept.append(piece)
    if not kept:
        raise GeometryError(
            f"none of {len(hulls)} convex pieces is {MIN_PIECE_THICKNESS_M * 1e3:g} mm thick: too small or too flat"
        )
    return tuple(kept)


def _thick(piece: TriangleMesh) -> TriangleMesh | None:
    """The piece, convex; None where it is flatter than `MIN_PIECE_THICKNESS_M`."""
    if not _is_convex(piece):
        try:
            piece = hull_mesh(piece.vertices)
        except ValueError:
            return None
    return None if 2 * signed_volume(piece) < MIN_PIECE_THICKNESS_M * surface_area(piece) else piece


def _is_convex(piece: TriangleMesh) -> bool:
    """Whether a hull, closed as hulls are, is still one: no corner stands out by more than rounding explains.

    One of too many corners may have some that its hull does without.
    """
    if len(piece.faces) != 2 * len(piece.vertices) - 4 or len(piece.vertices) > MAX_PIECE_VERTICES:
        return False
    allowed = LAST_DIGITS * 10.0 ** -decimals(piece.vertices)
    return float(face_heights(piece, piece.vertices).max()) <= allowed
