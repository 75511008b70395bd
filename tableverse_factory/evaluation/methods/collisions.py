"""The scene collision rate (paper, table 1) of any method, measured with one ruler for all.

A scene collides if any two of its objects lie deeper inside one another than epsilon. The depth is measured on the
meshes, as the paper counts, and on the convex pieces, as a simulator feels them (`geometry.penetration`).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from schemas.config import RectifyConfig
from tableverse_factory.core.errors import TableverseError
from tableverse_factory.evaluation.methods.scenes import MethodScene, Source
from tableverse_factory.geometry.collision.penetration import PairDepth, mesh_penetrations, piece_penetrations
from tableverse_factory.geometry.convex.decompose import decompose

Pair = tuple[str, str, float]
"""Names of two objects and how deep they overlap [m]."""

_Z95 = 1.959964


@dataclass(frozen=True, slots=True)
class SceneCollisions:
    """One scene.

    Attributes:
        objects: How many were compared, the table not counted.
        meshes: Pairs whose meshes share volume, deepest first.
        pieces: Pairs whose convex pieces overlap, deepest first; None where they were not measured.
        left_out: What was taken for the table, or stands still.
        error: Why the scene could not be measured; empty as a rule.
    """

    name: str
    objects: int = 0
    meshes: tuple[Pair, ...] = ()
    pieces: tuple[Pair, ...] | None = None
    left_out: tuple[str, ...] = ()
    error: str = ""

    @property
    def depth_m(self) -> float:
        """The deepest pair of meshes [m]."""
        return self.meshes[0][2] if self.meshes else 0.0

    @property
    def piece_depth_m(self) -> float | None:
        """The deepest pair on the pieces [m]."""
        if self.pieces is None:
            return None
        return self.pieces[0][2] if self.pieces else 0.0

    def as_json(self, epsilon_m: float) -> dict[str, Any]:
        """What a script reads: every pair, in metres."""
        if self.error:
            return {"scene": self.name, "error": self.error}
        return {
            "scene": self.name,
            "objects": self.objects,
            "left_out": list(self.left_out),
            "colliding": self.depth_m > epsilon_m,
            "depth_m": self.depth_m,
            "piece_depth_m": self.piece_depth_m,
            "meshes": _pairs_as_json(self.meshes),
            "pieces": None if self.pieces is None else _pairs_as_json(self.pieces),
        }


@dataclass(frozen=True, slots=True)
class MethodCollisions:
    """One method over all its scenes.

    Attributes:
        epsilon_m: Overlaps up to this depth are no collision [m].
        dropped: Scenes that the factory gave up, which are not among them; None where nobody knows.
    """

    method: str
    epsilon_m: float
    scenes: tuple[SceneCollisions, ...]
    dropped: int | None = None

    @property
    def measured(self) -> tuple[SceneCollisions, ...]:
        """The scenes that could be measured."""
        return tuple(scene for scene in self.scenes if not scene.error)

    def rate(self) -> float | None:
        """Share of the measured scenes that collide on the meshes; None without any."""
        return _share([scene.depth_m > self.epsilon_m for scene in self.measured])

    def piece_rate(self) -> float | None:
        """The same on the convex pieces, of those scenes whose pieces were measured."""
        depths = [scene.piece_depth_m for scene in self.measured]
        return _share([depth > self.epsilon_m for depth in depths if depth is not None])

    def interval(self) -> tuple[float, float] | None:
        """Wilson's 95 % interval of `rate`."""
        rate = self.rate()
        return None if rate is None else wilson(rate, len(self.measured))

    def as_json(self) -> dict[str, Any]:
        """What a script reads."""
        return {
            "method": self.method,
            "scenes": len(self.scenes),
            "measured": len(self.measured),
            "dropped": self.dropped,
            "collision_rate": self.rate(),
            "collision_rate_95": self.interval(),
            "piece_collision_rate": self.piece_rate(),
            "per_scene": [scene.as_json(self.epsilon_m) for scene in self.scenes],
        }


def measure_method(
    method: str, sources: Iterable[Source], epsilon_m: float, cache_dir: Path | None, dropped: int | None = None
) -> MethodCollisions:
    """Every scene of a method; with a `cache_dir` for convex pieces also on those, else on the meshes alone."""
    return MethodCollisions(method, epsilon_m, tuple(measure_scenes(sources, cache_dir)), dropped)


def measure_scenes(sources: Iterable[Source], cache_dir: Path | None) -> Iterator[SceneCollisions]:
    """Scene by scene; what cannot be read is a result with its reason, never left out silently."""
    for source in sources:
        try:
            yield measure_scene(source.name, source.read(), cache_dir)
        except TableverseError as error:
            yield SceneCollisions(source.name, error=str(error))


def measure_scene(name: str, scene: MethodScene, cache_dir: Path | None) -> SceneCollisions:
    """Depths of all pairs of one scene.

    Raises:
        GeometryError: if a mesh cannot be closed.
    """
    poses = [item.pose for item in scene.objects]
    scales = [item.scale for item in scene.objects]
    meshes = mesh_penetrations([item.mesh for item in scene.objects], poses, scales)
    pieces = None
    if cache_dir is not None:
        config = RectifyConfig()
        given = [item.pieces or decompose(item.mesh, config, cache_dir) for item in scene.objects]
        pieces = _named(scene, piece_penetrations(given, poses, scales))
    return SceneCollisions(name, len(scene.objects), _named(scene, meshes), pieces, scene.left_out)


def wilson(share: float, count: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a share of `count` trials."""
    square = _Z95**2
    middle = share + square / (2 * count)
    reach = _Z95 * float(np.sqrt(share * (1 - share) / count + square / (4 * count**2)))
    scale = 1 + square / count
    return max(0.0, (middle - reach) / scale), min(1.0, (middle + reach) / scale)


def _named(scene: MethodScene, depths: Sequence[PairDepth]) -> tuple[Pair, ...]:
    names = [item.name for item in scene.objects]
    return tuple((names[i], names[j], depth) for i, j, depth in sorted(depths, key=lambda pair: -pair[2]))


def _pairs_as_json(pairs: Sequence[Pair]) -> list[dict[str, Any]]:
    return [{"a": a, "b": b, "depth_m": depth} for a, b, depth in pairs]


def _share(colliding: Sequence[bool]) -> float | None:
    return sum(colliding) / len(colliding) if colliding else None
