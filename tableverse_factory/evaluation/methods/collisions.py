"""Scene collision rate (paper, table 1) of any method, measured alike for all.

A scene collides if two of its objects overlap by more than epsilon. The depth is measured on the meshes, as in the
paper, and on the convex pieces, which a simulator uses (`geometry.collision.penetration`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from schemas.config import RectifyConfig
from tableverse_factory.core.errors import TableverseError
from tableverse_factory.evaluation.methods.scenes import MethodScene, SceneSource
from tableverse_factory.geometry.collision.penetration import (
    PairDepth,
    measure_mesh_penetrations,
    measure_piece_penetrations,
)
from tableverse_factory.geometry.convex.decompose import decompose

Pair = tuple[str, str, float]  # names of two objects and the depth of their overlap [m]

_Z95 = 1.959964


@dataclass(frozen=True, slots=True)
class SceneCollisions:
    """Collisions of one scene."""

    name: str
    objects: int = 0  # number of objects compared, without the table
    meshes: tuple[Pair, ...] = ()  # pairs with overlapping meshes, deepest first
    pieces: tuple[Pair, ...] | None = None  # the same for convex pieces; None if they were not measured
    left_out: tuple[str, ...] = ()  # names of static bodies and of the table
    error: str = ""  # why the scene could not be measured, or empty

    @property
    def depth_m(self) -> float:
        """Deepest overlap of meshes [m]."""
        return self.meshes[0][2] if self.meshes else 0.0

    @property
    def piece_depth_m(self) -> float | None:
        """Deepest overlap of pieces [m]."""
        if self.pieces is None:
            return None
        return self.pieces[0][2] if self.pieces else 0.0

    def as_json(self, epsilon_m: float) -> dict[str, Any]:
        """Return plain values for JSON: every pair, in metres."""
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
    """Collisions of one method over all its scenes."""

    method: str
    epsilon_m: float  # depth beyond which objects collide [m]
    scenes: tuple[SceneCollisions, ...]  # measured scenes, and those that could not be measured
    dropped: int | None = None  # scenes that the factory dropped, not among these; None if unknown

    @property
    def measured(self) -> tuple[SceneCollisions, ...]:
        """Scenes that could be measured."""
        return tuple(scene for scene in self.scenes if not scene.error)

    def rate(self) -> float | None:
        """Compute the share of measured scenes that collide on the meshes; None without any."""
        return _compute_share([scene.depth_m > self.epsilon_m for scene in self.measured])

    def piece_rate(self) -> float | None:
        """Compute the same on the convex pieces, over the scenes whose pieces were measured."""
        depths = [scene.piece_depth_m for scene in self.measured]
        return _compute_share([depth > self.epsilon_m for depth in depths if depth is not None])

    def interval(self) -> tuple[float, float] | None:
        """Compute Wilson's 95 % interval of `rate`."""
        rate = self.rate()
        return None if rate is None else compute_wilson_interval(rate, len(self.measured))

    def as_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
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
    method: str, sources: Iterable[SceneSource], epsilon_m: float, cache_dir: Path | None, dropped: int | None = None
) -> MethodCollisions:
    """Measure every scene of a method, with a `cache_dir` also on convex pieces; unreadable ones state their error."""
    scenes = []
    for source in sources:
        try:
            scenes.append(measure_scene(source.name, source.read(), cache_dir))
        except TableverseError as error:
            scenes.append(SceneCollisions(source.name, error=str(error)))
    return MethodCollisions(method, epsilon_m, tuple(scenes), dropped)


def measure_scene(name: str, scene: MethodScene, cache_dir: Path | None) -> SceneCollisions:
    """Measure the depths of all pairs of one scene; raise a `GeometryError` if a mesh cannot be closed."""
    poses = [item.pose for item in scene.objects]
    scales = [item.scale for item in scene.objects]
    meshes = measure_mesh_penetrations([item.mesh for item in scene.objects], poses, scales)
    pieces = None
    if cache_dir is not None:
        config = RectifyConfig()
        given = [item.pieces or decompose(item.mesh, config, cache_dir) for item in scene.objects]
        pieces = _name_pairs(scene, measure_piece_penetrations(given, poses, scales))
    return SceneCollisions(name, len(scene.objects), _name_pairs(scene, meshes), pieces, scene.left_out)


def compute_wilson_interval(share: float, count: int) -> tuple[float, float]:
    """Compute Wilson's 95 % score interval of a share of `count` trials."""
    square = _Z95**2
    middle = share + square / (2 * count)
    reach = _Z95 * float(np.sqrt(share * (1 - share) / count + square / (4 * count**2)))
    scale = 1 + square / count
    return max(0.0, (middle - reach) / scale), min(1.0, (middle + reach) / scale)


def _name_pairs(scene: MethodScene, depths: Sequence[PairDepth]) -> tuple[Pair, ...]:
    names = [item.name for item in scene.objects]
    return tuple((names[i], names[j], depth) for i, j, depth in sorted(depths, key=lambda pair: -pair[2]))


def _pairs_as_json(pairs: Sequence[Pair]) -> list[dict[str, Any]]:
    return [{"a": a, "b": b, "depth_m": depth} for a, b, depth in pairs]


def _compute_share(colliding: Sequence[bool]) -> float | None:
    return sum(colliding) / len(colliding) if colliding else None
