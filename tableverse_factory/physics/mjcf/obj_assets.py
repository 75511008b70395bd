"""Mesh files of a scene: OBJ with fixed decimals, so that equal meshes give equal bytes everywhere."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float64, Int64

from schemas.geometry import Frozen, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.core.memoize import memoize_by_content
from tableverse_factory.geometry.math.aabb import aabb_size
from tableverse_factory.geometry.mesh.hulls import compute_face_heights, make_hull_mesh
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume
from tableverse_factory.geometry.mesh.surface_samples import compute_surface_area
from tableverse_factory.physics.mjcf.number_format import format_decimal_lines, format_integer_lines

MAX_PIECE_VERTICES = 64
MIN_MESH_VERTICES = 4
MIN_PIECE_THICKNESS_M = 5e-5  # thinner convex pieces carry nothing in a simulation and make MuJoCo's own hull fail
REMEMBERED_BYTES = 64 * 1024 * 1024  # OBJ files of a hundred things
ROUNDING_UNITS = 4  # units of the last digit by which rounding may lift a corner over the plane of a compact face


@dataclass(frozen=True, slots=True, eq=False)
class Appearance(Frozen):
    """Colours of a mesh as a texture: distinct uv coordinates, v upwards, and their indices at each face's corners."""

    texture_png: bytes
    points: Float64[np.ndarray, "k 2"]
    corners: Int64[np.ndarray, "m 3"]

    @classmethod
    def at_corners(cls, texture_png: bytes, corner_uv: Float64[np.ndarray, "m 3 2"]) -> "Appearance":
        """Make it from the uv coordinates at each face's corners."""
        points, index = _find_distinct(corner_uv.reshape(-1, 2))
        return cls(texture_png, points, index.reshape(-1, 3))

    @property
    def corner_uv(self) -> Float64[np.ndarray, "m 3 2"]:
        """The uv coordinates at each face's corners."""
        return self.points[self.corners]


def scale_and_quantize(mesh: TriangleMesh, scale: float) -> TriangleMesh:
    """Scale a mesh to metres and round it as its file is written, so that the certificate measures the file.

    A lone triangle gets a fourth, unused vertex in its middle, as MuJoCo refuses meshes of three.
    """
    vertices = mesh.vertices * scale
    colors = mesh.vertex_colors
    if len(vertices) < MIN_MESH_VERTICES:
        vertices = np.concatenate([vertices, vertices.mean(axis=0, keepdims=True)])
        colors = None if colors is None else np.concatenate([colors, colors[:1]])
    return replace(mesh, vertices=np.round(vertices, count_decimals(vertices)) + 0.0, vertex_colors=colors)


def count_decimals(vertices: np.ndarray) -> int:
    """Count the decimals to write: a tenth of a micrometre, and finer for objects under a centimetre."""
    extent = float(aabb_size(vertices).max())
    return 7 + max(0, int(np.ceil(-2 - np.log10(max(extent, 1e-9)))))


def encode_obj(mesh: TriangleMesh, appearance: Appearance | None = None) -> bytes:
    """Encode a mesh of `scale_and_quantize` as OBJ."""
    text = format_decimal_lines(b"v ", mesh.vertices, count_decimals(mesh.vertices), b"  \n")
    corners = mesh.faces.astype(np.int64) + 1
    if appearance is None:
        return text + format_integer_lines(b"f ", corners, b"  \n")
    table = np.stack([corners, appearance.corners + 1], axis=2).reshape(-1, 6)
    points = format_decimal_lines(b"vt ", appearance.points, 6, b" \n")
    return text + points + format_integer_lines(b"f ", table, b"/ / /\n")


# By identity: `make_body_shape` gives equal shapes the same pieces, in settling, in export and in scene after scene.
encode_piece = lru_cache(2048)(encode_obj)


def encode_visual(mesh: TriangleMesh, appearance: Appearance | None) -> bytes:
    """Encode a visual mesh, once for the same thing at the same scale in many scenes."""
    shape = replace(mesh, vertex_colors=None, texture=None)  # pictures are in no OBJ file
    return _encode_shape(shape, None if appearance is None else replace(appearance, texture_png=b""))


@memoize_by_content(REMEMBERED_BYTES)
def _encode_shape(mesh: TriangleMesh, appearance: Appearance | None) -> bytes:
    return encode_obj(mesh, appearance)


def _find_distinct(points: Float64[np.ndarray, "n 2"]) -> tuple[Float64[np.ndarray, "k 2"], Int64[np.ndarray, " n"]]:
    """Distinct points in order, and the index of each; by coordinates, which sorts numbers only."""
    (u, column), (v, row) = (np.unique(points[:, axis], return_inverse=True) for axis in (0, 1))
    pair, index = np.unique(column * len(v) + row, return_inverse=True)
    return np.stack([u[pair // len(v)], v[pair % len(v)]], axis=1), index


def prepare_hulls(hulls: tuple[TriangleMesh, ...], scale: float) -> tuple[TriangleMesh, ...]:
    """Scale and round convex pieces, without those too thin to simulate; dented ones are made convex again.

    Raises:
        GeometryError: if nothing is left, or a piece has more vertices than MuJoCo's fast path takes.
    """
    solid = (_make_thick_piece(scale_and_quantize(hull, scale)) for hull in hulls if len(hull.vertices) >= 4)
    kept = tuple(piece for piece in solid if piece is not None)
    if many := [len(piece.vertices) for piece in kept if len(piece.vertices) > MAX_PIECE_VERTICES]:
        raise GeometryError(f"a convex piece has {many[0]} vertices; at most {MAX_PIECE_VERTICES}")
    if not kept:
        thick = f"{MIN_PIECE_THICKNESS_M * 1e3:g} mm thick"
        raise GeometryError(f"none of {len(hulls)} convex pieces is {thick}: too small or too flat")
    return kept


def _make_thick_piece(piece: TriangleMesh) -> TriangleMesh | None:
    """Make a piece convex; None where it is flatter than `MIN_PIECE_THICKNESS_M`."""
    if not _is_convex(piece):
        try:
            piece = make_hull_mesh(piece.vertices)
        except GeometryError:
            return None
    return None if 2 * compute_signed_volume(piece) < MIN_PIECE_THICKNESS_M * compute_surface_area(piece) else piece


def _is_convex(piece: TriangleMesh) -> bool:
    """Whether a closed hull is still convex up to rounding; one of too many vertices is hulled again in any case."""
    if len(piece.faces) != 2 * len(piece.vertices) - 4 or len(piece.vertices) > MAX_PIECE_VERTICES:
        return False
    allowed = ROUNDING_UNITS * 10.0 ** -count_decimals(piece.vertices)
    return float(compute_face_heights(piece, piece.vertices).max()) <= allowed
