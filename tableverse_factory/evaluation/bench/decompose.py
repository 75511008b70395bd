"""Comparison of methods of convex decomposition on the same meshes: time, pieces, volume, open cavities."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import mean

import numpy as np

from schemas.config import RectifyConfig
from schemas.geometry import ConvexPieces, Points, TriangleMesh
from tableverse_factory.core.errors import InputError
from tableverse_factory.geometry.convex.coacd import load_coacd
from tableverse_factory.geometry.convex.decompose import decompose_shape
from tableverse_factory.geometry.convex.metrics import add_metrics
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.hulls import make_bounded_hull
from tableverse_factory.geometry.mesh.repair import make_closed_solid


@dataclass(frozen=True, slots=True)
class PieceScore:
    """Score of one method on one mesh, or on several: the sums of time and pieces, the means of the rest."""

    mesh: str
    method: str  # key of `DECOMPOSITIONS`
    cpu_s: float  # CPU time of repair, simplification and decomposition [s]
    faster: float  # CPU time of the first method over that of this one
    pieces: int
    volume_ratio: float  # volume of the union of the pieces over that of the mesh
    volume_error: float  # absolute difference of `volume_ratio` from 1
    hausdorff: float  # Hausdorff distance between mesh and pieces over the longest side of the mesh
    cavity_kept: float  # share of the space between the mesh and its hull that stays open


def _coacd_defaults(shape: TriangleMesh) -> list[Points]:
    coacd = load_coacd()
    found = coacd.run_coacd(coacd.Mesh(np.array(shape.vertices), np.array(shape.faces)), seed=0)
    return [np.asarray(vertices, dtype=np.float64) for vertices, _ in found]


def _ours(decomposition: str) -> Callable[[TriangleMesh], list[Points]]:
    config = RectifyConfig.model_validate({"decomposition": decomposition})
    return lambda shape: [hull.vertices for hull in decompose_shape(shape, config).hulls]


DECOMPOSITIONS: dict[str, Callable[[TriangleMesh], list[Points]]] = {
    "coacd defaults": _coacd_defaults,
    "coacd": _ours("coacd"),
    "cut": _ours("cut"),
}


def check_methods(methods: Sequence[str]) -> None:
    """Check that all methods are keys of `DECOMPOSITIONS`, each named once, else raise `InputError`."""
    for name in methods:
        if name not in DECOMPOSITIONS:
            raise InputError(f"unknown method {name!r}: choose from {', '.join(DECOMPOSITIONS)}")
        if methods.count(name) > 1:
            raise InputError(f"method {name!r} is named twice: once is enough")


def bench_decompose(
    meshes: Sequence[tuple[str, TriangleMesh]],
    methods: Sequence[str],
    on_mesh: Callable[[], object] = lambda: None,
) -> list[PieceScore]:
    """Run methods (keys of `DECOMPOSITIONS`) on every named mesh and compare the pieces with the repaired solid."""
    scores: list[PieceScore] = []
    for name, mesh in meshes:
        scores += _measure_mesh(name, mesh, methods)
        on_mesh()
    return scores


def _measure_mesh(name: str, mesh: TriangleMesh, methods: Sequence[str]) -> list[PieceScore]:
    shape = _scale_to_unit(mesh)
    solid, _ = make_closed_solid(shape)
    scores: list[PieceScore] = []
    for method in methods:
        started = time.process_time()
        corners = DECOMPOSITIONS[method](shape)
        cpu_s = time.process_time() - started
        hulls = tuple(make_bounded_hull(points, len(points), 0.0) for points in corners)
        pieces = add_metrics(ConvexPieces(hulls, 0.0, 0.0, method), solid)
        first_s = scores[0].cpu_s if scores else cpu_s
        scores.append(
            PieceScore(
                mesh=name,
                method=method,
                cpu_s=cpu_s,
                faster=_over(first_s, cpu_s),
                pieces=len(hulls),
                volume_ratio=pieces.volume_ratio,
                volume_error=abs(pieces.volume_ratio - 1.0),
                hausdorff=pieces.hausdorff_m,
                cavity_kept=pieces.cavity_kept,
            )
        )
    return scores


_AVERAGED = ("volume_ratio", "volume_error", "hausdorff", "cavity_kept")


def summarize_pieces(scores: Sequence[PieceScore], methods: Sequence[str]) -> list[PieceScore]:
    """Summarize the scores of each method over all meshes."""
    groups = [[score for score in scores if score.method == name] for name in methods]
    seconds = [sum(score.cpu_s for score in group) for group in groups]
    return [
        PieceScore(
            mesh="together",
            method=name,
            cpu_s=cpu_s,
            faster=_over(seconds[0], cpu_s),
            pieces=sum(score.pieces for score in group),
            **{name: mean(getattr(score, name) for score in group) for name in _AVERAGED},
        )
        for name, group, cpu_s in zip(methods, groups, seconds, strict=True)
    ]


def _over(first_s: float, cpu_s: float) -> float:
    return first_s / max(cpu_s, 1e-6)


def _scale_to_unit(mesh: TriangleMesh) -> TriangleMesh:
    low, high = aabb(mesh.vertices)
    return TriangleMesh((mesh.vertices - (low + high) / 2) / float((high - low).max()), mesh.faces)
