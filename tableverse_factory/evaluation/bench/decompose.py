"""Convex decomposition, method beside method on the same meshes: time, pieces, volume error, what stays open."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

import numpy as np

from schemas.config import RectifyConfig
from schemas.geometry import ConvexPieces, Points, TriangleMesh
from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.bench.layouts import spread_out
from tableverse_factory.geometry.convex.coacd import coacd_library
from tableverse_factory.geometry.convex.decompose import pieces_of_shape
from tableverse_factory.geometry.convex.metrics import with_metrics
from tableverse_factory.geometry.mesh.hulls import bounded_hull
from tableverse_factory.geometry.mesh.meshes import MESH_SUFFIXES, bounds, read_mesh
from tableverse_factory.geometry.mesh.repair import closed_solid


@dataclass(frozen=True, slots=True)
class PieceScore:
    """One method on one mesh; of several meshes: time and pieces in sum, the rest in the mean.

    Attributes:
        mesh: File name.
        method: Key of `METHODS`.
        cpu_s: With repair and simplification, without the measuring [s].
        faster: CPU time of the first method over this one's.
        pieces: How many.
        volume_ratio: Volume of their union over the mesh's.
        volume_error: How far that is from 1.
        hausdorff: Largest distance between mesh and pieces, a share of the mesh's longest side.
        cavity_kept: Share of the space between the mesh and its hull that stays open.
    """

    mesh: str
    method: str
    cpu_s: float
    faster: float
    pieces: int
    volume_ratio: float
    volume_error: float
    hausdorff: float
    cavity_kept: float


def _coacd_defaults(shape: TriangleMesh) -> list[Points]:
    coacd = coacd_library()
    found = coacd.run_coacd(coacd.Mesh(np.array(shape.vertices), np.array(shape.faces)), seed=0)
    return [np.asarray(vertices, dtype=np.float64) for vertices, _ in found]


def _ours(decomposition: str) -> Callable[[TriangleMesh], list[Points]]:
    config = RectifyConfig.model_validate({"decomposition": decomposition})
    return lambda shape: [hull.vertices for hull in pieces_of_shape(shape, config).hulls]


METHODS: dict[str, Callable[[TriangleMesh], list[Points]]] = {
    "coacd defaults": _coacd_defaults,
    "coacd": _ours("coacd"),
    "cut": _ours("cut"),
}


def bench_decompose(
    files: Sequence[Path], methods: Sequence[str], on_mesh: Callable[[], None] | None = None
) -> list[PieceScore]:
    """Every method on every mesh; all are measured the same way against the repaired solid.

    Args:
        files: Meshes.
        methods: Keys of `METHODS`.
        on_mesh: Called after each mesh.

    Raises:
        InputError: if there is no mesh, or a method is unknown.
        GeometryError: if a mesh cannot be made a solid.
    """
    if unknown := [name for name in methods if name not in METHODS]:
        raise InputError(f"unknown method {unknown[0]!r}: give some of {', '.join(METHODS)}")
    if not files:
        raise InputError(f"no mesh found: give a folder of {', '.join(MESH_SUFFIXES)} files")
    scores: list[PieceScore] = []
    for file in files:
        scores += _compared(file, methods)
        if on_mesh is not None:
            on_mesh()
    return scores


def _compared(file: Path, methods: Sequence[str]) -> list[PieceScore]:
    shape = _of_size_one(read_mesh(file.read_bytes(), file.name))
    solid, _ = closed_solid(shape)
    scores: list[PieceScore] = []
    for name in methods:
        started = time.process_time()
        corners = METHODS[name](shape)
        cpu_s = time.process_time() - started
        hulls = tuple(bounded_hull(points, len(points), 0.0) for points in corners)
        pieces = with_metrics(ConvexPieces(hulls, 0.0, 0.0, name), solid)
        first_s = scores[0].cpu_s if scores else cpu_s
        scores.append(
            PieceScore(
                mesh=file.name,
                method=name,
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


def together(scores: Sequence[PieceScore], methods: Sequence[str]) -> list[PieceScore]:
    """The scores of each method over all meshes."""
    groups = [[score for score in scores if score.method == name] for name in methods]
    seconds = [sum(score.cpu_s for score in group) for group in groups]
    return [
        PieceScore(
            mesh="together",
            method=name,
            cpu_s=cpu_s,
            faster=_over(seconds[0], cpu_s),
            pieces=sum(score.pieces for score in group),
            volume_ratio=mean(score.volume_ratio for score in group),
            volume_error=mean(score.volume_error for score in group),
            hausdorff=mean(score.hausdorff for score in group),
            cavity_kept=mean(score.cavity_kept for score in group),
        )
        for name, group, cpu_s in zip(methods, groups, seconds, strict=True)
    ]


def _over(first_s: float, cpu_s: float) -> float:
    return first_s / max(cpu_s, 1e-6)


def mesh_files(folder: Path, most: int | None) -> list[Path]:
    """The folder's meshes in the order of their names, at most so many, spread evenly."""
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in MESH_SUFFIXES)
    return spread_out(found, most)


def _of_size_one(mesh: TriangleMesh) -> TriangleMesh:
    low, high = bounds(mesh)
    return TriangleMesh((mesh.vertices - (low + high) / 2) / float((high - low).max()), mesh.faces)
