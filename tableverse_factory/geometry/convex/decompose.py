"""A mesh as few convex pieces: what the simulator feels.

The shape is brought to one size first, so that a mesh at another scale or place has the same pieces, and the cache
knows it. Whether the answer comes from the cache changes nothing: what is stored is what would be computed.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import manifold3d
import numpy as np

from schemas.config import RectifyConfig
from schemas.geometry import ConvexPieces, TriangleMesh, Vector3
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.convex.bounded_pieces import bounded_pieces, piece_of
from tableverse_factory.geometry.convex.cache import PieceCache
from tableverse_factory.geometry.convex.coacd import coacd_pieces
from tableverse_factory.geometry.convex.cut_and_merge import cut_and_merge
from tableverse_factory.geometry.convex.metrics import with_metrics
from tableverse_factory.geometry.mesh.mass_integrals import signed_volume
from tableverse_factory.geometry.mesh.meshes import bounds, checked
from tableverse_factory.geometry.mesh.repair import as_mesh, closed_solid

FEW_FACES = 5_000
"""What is no larger is taken as it is."""
MANY_SHELLS = 500
"""So many cannot be simplified to few faces, and none of them will be cut."""
SIMPLIFY_TOLERANCES = (4e-4, 2e-4, 1e-4, 0.0)
"""The coarsest that keeps the volume within `SIMPLIFY_VOLUME` is taken: thin walls need a finer one. Lengths here are
shares of the mesh's longest side."""
SIMPLIFY_VOLUME = 0.01
MAX_FACES = 20_000
"""What is still larger after that is simplified further, twice as coarsely each time."""
GRID = 2.0**-30
"""Shapes are rounded to this, so that scale leaves no trace in the last bits."""


@dataclass(frozen=True, slots=True, eq=False)
class _Norm:
    """The mesh's own frame, seen from the frame in which its longest side is 1 and its box is centred."""

    center: Vector3
    size: float


def decompose(mesh: TriangleMesh, config: RectifyConfig, cache_dir: Path) -> ConvexPieces:
    """Convex pieces that cover the mesh, in the mesh's own frame and at scale 1.

    Raises:
        GeometryError: if the mesh cannot be made a solid.
    """
    norm = _norm_of(checked(mesh, "mesh"))
    shape = TriangleMesh(np.round((mesh.vertices - norm.center) / norm.size / GRID) * GRID, mesh.faces)
    cache = PieceCache(cache_dir, config)
    key = cache.key(shape)
    pieces = cache.get(key)
    if pieces is None:
        pieces = pieces_of_shape(shape, config)
        cache.put(key, pieces)
    return _scaled(pieces, norm)


def pieces_of_shape(shape: TriangleMesh, config: RectifyConfig) -> ConvexPieces:
    """Convex pieces of a mesh about 1 large."""
    solid, repaired = closed_solid(shape)
    method, hulls = _hulls(solid, config)
    return with_metrics(ConvexPieces(tuple(hulls), 0.0, 0.0, method, repaired), solid)


def _hulls(solid: manifold3d.Manifold, config: RectifyConfig) -> tuple[str, list[TriangleMesh]]:
    """How the pieces were made, and the pieces; what is nearly convex needs no search."""
    allowed = (1.0 + config.volume_error) * float(solid.volume())
    whole = piece_of(as_mesh(solid).vertices)
    if config.max_pieces == 1 or signed_volume(whole) <= allowed:
        return "convex", [whole]
    if config.decomposition == "coacd":
        return "coacd", [piece_of(points) for points in coacd_pieces(as_mesh(_simplified(solid)), config.max_pieces)]
    clusters = cut_and_merge(_simplified(solid), config.max_pieces, config.volume_error)
    return "cut", bounded_pieces(clusters, config.max_pieces, allowed)


def _simplified(solid: manifold3d.Manifold) -> manifold3d.Manifold:
    if solid.num_tri() <= FEW_FACES or len(solid.decompose()) > MANY_SHELLS:
        return solid
    volume = float(solid.volume())
    for tolerance in SIMPLIFY_TOLERANCES:
        simple = solid.simplify(tolerance)
        if abs(float(simple.volume()) - volume) <= SIMPLIFY_VOLUME * volume:
            break
    tolerance = SIMPLIFY_TOLERANCES[0]
    while simple.num_tri() > MAX_FACES:
        tolerance *= 2.0
        if tolerance > 0.1:
            raise GeometryError(f"a mesh of {solid.num_tri()} triangles cannot be simplified to {MAX_FACES}")
        simple = solid.simplify(tolerance)
    return simple


def _norm_of(mesh: TriangleMesh) -> _Norm:
    low, high = bounds(mesh)
    return _Norm((low + high) / 2, float((high - low).max()))


def _scaled(pieces: ConvexPieces, norm: _Norm) -> ConvexPieces:
    return replace(
        pieces,
        hulls=tuple(TriangleMesh(norm.center + norm.size * hull.vertices, hull.faces) for hull in pieces.hulls),
        hausdorff_m=norm.size * pieces.hausdorff_m,
        uncovered_m=norm.size * pieces.uncovered_m,
    )
