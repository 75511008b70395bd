"""Convex decomposition, method beside method on the same meshes: time, pieces, volume error, what stays open."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import coacd
import numpy as np

from schemas.config import RectifyConfig
from schemas.geometry import ConvexPieces, Points, TriangleMesh
from tableverse_factory.errors import InputError
from tableverse_factory.geometry.convex import pieces_of_shape
from tableverse_factory.geometry.hulls import bounded_hull
from tableverse_factory.geometry.meshes import MESH_SUFFIXES, bounds, read_mesh
from tableverse_factory.geometry.piece_quality import measured
from tableverse_factory.geometry.repair import closed_solid


@dataclass(frozen=True, slots=True)
class PieceScore:
    """One method on one mesh.

    Attributes:
        mesh: File name.
        method: Key of `METHODS`.
        cpu_s: With repair and simplification, without the measuring [s].
        pieces: How many.
        volume_ratio: Volume of their union over the mesh's.
        hausdorff: Largest distance between mesh and pieces, a share of the mesh's longest side.
        cavity_kept: Share of the space between the mesh and its hull that stays open.
    """

    mesh: str
    method: str
    cpu_s: float
    pieces: int
    volume_ratio: float
    hausdorff: float
    cavity_kept: float


def _coacd_defaults(shape: TriangleMesh) -> list[Points]:
    coacd.set_log_level("error")
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


def bench_decompose(files: Sequence[Path], methods: Sequence[str]) -> Iterator[PieceScore]:
    """Every method on every mesh, as they finish; all are measured the same way against the repaired solid.

    Raises:
        InputError: if there is no mesh, or a method is unknown.
    """
    if unknown := [name for name in methods if name not in METHODS]:
        raise InputError(f"unknown method {unknown[0]!r}: give some of {', '.join(METHODS)}")
    if not files:
        raise InputError(f"no mesh found: give a folder of {', '.join(MESH_SUFFIXES)} files")
    for file in files:
        shape = _of_size_one(read_mesh(file.read_bytes(), file.name))
        solid, _ = closed_solid(shape)
        for name in methods:
            started = time.process_time()
            corners = METHODS[name](shape)
            cpu_s = time.process_time() - started
            hulls = tuple(bounded_hull(points, len(points), 0.0) for points in corners)
            pieces = measured(ConvexPieces(hulls, 0.0, 0.0, name), solid)
            kept = pieces.volume_ratio, pieces.hausdorff_m, pieces.cavity_kept
            yield PieceScore(file.name, name, cpu_s, len(hulls), *kept)


def mesh_files(folder: Path, most: int | None) -> list[Path]:
    """The folder's meshes in the order of their names, at most so many, spread evenly."""
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in MESH_SUFFIXES)
    if most is None or len(found) <= most:
        return found
    return [found[index] for index in np.linspace(0, len(found) - 1, most).round().astype(int).tolist()]


def _of_size_one(mesh: TriangleMesh) -> TriangleMesh:
    low, high = bounds(mesh)
    return TriangleMesh((mesh.vertices - (low + high) / 2) / float((high - low).max()), mesh.faces)
