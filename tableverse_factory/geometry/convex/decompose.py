"""Convex decomposition of meshes; shapes are normalised first, so that scale and place change no cache entry."""

from dataclasses import replace
from pathlib import Path

import manifold3d
import numpy as np

from schemas.config import RectifyConfig
from schemas.geometry import ConvexPieces, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.convex.bounded_pieces import make_bounded_pieces, make_piece
from tableverse_factory.geometry.convex.cache import PieceCache
from tableverse_factory.geometry.convex.coacd import decompose_with_coacd
from tableverse_factory.geometry.convex.cut_and_merge import cut_and_merge
from tableverse_factory.geometry.convex.metrics import add_metrics
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume
from tableverse_factory.geometry.mesh.meshes import check_mesh
from tableverse_factory.geometry.mesh.repair import make_closed_solid, solid_to_mesh

FEW_FACES = 5_000  # smaller meshes are not simplified
MANY_SHELLS = 500  # more shells cannot be simplified to few faces, and none of them will be cut
# Shares of the longest side; the coarsest that keeps the volume to `SIMPLIFY_VOLUME`: thin walls need a finer one.
SIMPLIFY_TOLERANCES = (4e-4, 2e-4, 1e-4, 0.0)
SIMPLIFY_VOLUME = 0.01
MAX_FACES = 20_000  # larger meshes are simplified further, twice as coarsely each time
GRID = 2.0**-30  # shapes are rounded to this, so that scale leaves no trace in the last bits


def decompose(mesh: TriangleMesh, config: RectifyConfig, cache_dir: Path) -> ConvexPieces:
    """Decompose a mesh into convex pieces that cover it, in its own frame and at scale 1."""
    low, high = aabb(check_mesh(mesh, "mesh").vertices)
    center, size = (low + high) / 2, float((high - low).max())
    shape = TriangleMesh(np.round((mesh.vertices - center) / size / GRID) * GRID, mesh.faces)
    cache = PieceCache(cache_dir, config)
    key = cache.key(shape)
    pieces = cache.get(key)
    if pieces is None:
        pieces = decompose_shape(shape, config)
        cache.put(key, pieces)
    return replace(
        pieces,
        hulls=tuple(TriangleMesh(center + size * hull.vertices, hull.faces) for hull in pieces.hulls),
        hausdorff_m=size * pieces.hausdorff_m,
        uncovered_m=size * pieces.uncovered_m,
    )


def decompose_shape(shape: TriangleMesh, config: RectifyConfig) -> ConvexPieces:
    """Decompose a mesh of extent 1."""
    solid, repaired = make_closed_solid(shape)
    method, hulls = _make_hulls(solid, config)
    return add_metrics(ConvexPieces(tuple(hulls), 0.0, 0.0, method, repaired), solid)


def _make_hulls(solid: manifold3d.Manifold, config: RectifyConfig) -> tuple[str, list[TriangleMesh]]:
    """Make the pieces, and name the method; a nearly convex shape needs no search."""
    allowed = (1.0 + config.volume_error) * float(solid.volume())
    whole = make_piece(solid_to_mesh(solid).vertices)
    if config.max_pieces == 1 or compute_signed_volume(whole) <= allowed:
        return "convex", [whole]
    if config.decomposition == "coacd":
        found = decompose_with_coacd(solid_to_mesh(_simplify(solid)), config.max_pieces)
        return "coacd", [make_piece(points) for points in found]
    clusters = cut_and_merge(_simplify(solid), config.max_pieces, config.volume_error)
    return "cut", make_bounded_pieces(clusters, config.max_pieces, allowed)


def _simplify(solid: manifold3d.Manifold) -> manifold3d.Manifold:
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
