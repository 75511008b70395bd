"""Settled scenes of simple solids at known places, for the tests of curation and of the gallery."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from schemas.config import RectifyConfig
from schemas.geometry import ConvexPieces, Pose, TriangleMesh
from schemas.objects import PlacedObject, PlacedObjects, Table
from schemas.scene import RectifiedLayout, SettledScene
from tableverse_factory.geometry.convex.decompose import decompose
from tableverse_factory.geometry.math.transforms import quaternion_about_z
from tableverse_factory.geometry.mesh.hulls import make_bounded_hull
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume
from tableverse_factory.geometry.mesh.meshes import from_trimesh

_KNOWN: dict[bytes, tuple[TriangleMesh, ...]] = {}


@dataclass(frozen=True)
class Thing:
    """A solid that stands with its lowest point at `z`, its middle at (x, y)."""

    label: str
    mesh: TriangleMesh
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0
    score: float = 1.0


def box(dx: float, dy: float, dz: float, color: Sequence[int] | None = None) -> TriangleMesh:
    return _painted(trimesh.creation.box((dx, dy, dz)), color)


def cylinder(radius: float, height: float, color: Sequence[int] | None = None) -> TriangleMesh:
    return _painted(trimesh.creation.cylinder(radius, height, sections=48), color)


def ball(radius: float, color: Sequence[int] | None = None) -> TriangleMesh:
    return _painted(trimesh.creation.icosphere(3, radius), color)


def vessel(radius: float, height: float, wall: float = 0.004, color: Sequence[int] | None = None) -> TriangleMesh:
    """A round vessel that is open at the top."""
    outline = [(0, 0), (radius, 0), (radius, height), (radius - wall, height), (radius - wall, wall), (0, wall)]
    solid = trimesh.creation.revolve(np.array(outline), sections=48)
    solid.apply_translation([0, 0, -height / 2])
    return _painted(solid, color)


def _painted(solid: trimesh.Trimesh, color: Sequence[int] | None) -> TriangleMesh:
    mesh = from_trimesh(trimesh.Trimesh(solid.vertices, solid.faces, process=False))
    colors = None if color is None else np.tile(np.array(color, dtype=np.uint8), (len(mesh.vertices), 1))
    return TriangleMesh(mesh.vertices, mesh.faces, colors)


def settled(
    things: Sequence[Thing], half_size: tuple[float, float] = (0.6, 0.45), scene_id: str = "scene"
) -> SettledScene:
    poses = tuple(
        Pose(np.array([t.x, t.y, t.z - float(t.mesh.vertices[:, 2].min())]), quaternion_about_z(t.yaw)) for t in things
    )
    objects = tuple(
        PlacedObject(f"obj_{i:03d}", t.label, t.score, t.mesh, 1.0, pose)
        for i, (t, pose) in enumerate(zip(things, poses, strict=True))
    )
    table = Table(np.zeros(2), np.array(half_size), 0.0, (180, 150, 120), 0.0)
    placed = PlacedObjects(scene_id, table, objects)
    pieces = tuple(ConvexPieces(_felt(t.mesh), 1.0, 0.0, "convex") for t in things)
    layout = RectifiedLayout(scene_id, placed, pieces, poses, tuple(range(len(things))), 0.0)
    return SettledScene(scene_id, layout, poses, 0.5)


def _felt(mesh: TriangleMesh) -> tuple[TriangleMesh, ...]:
    """The pieces of a mesh, made once: hundreds of tests set the same few tables."""
    key = mesh.vertices.tobytes() + mesh.faces.tobytes()
    if key not in _KNOWN:
        _KNOWN[key] = _pieces(mesh)
    return _KNOWN[key]


def _pieces(mesh: TriangleMesh) -> tuple[TriangleMesh, ...]:
    """The hull of what is convex, floor and staves of a `vessel`, and what a build makes of all else."""
    hull = make_bounded_hull(mesh.vertices, 64, 0.0)
    if compute_signed_volume(mesh) > 0.8 * compute_signed_volume(hull):
        return (hull,)
    x, y, z = mesh.vertices.T
    sector = np.rint(np.arctan2(y, x) / (2 * np.pi) * 48).astype(int) % 48
    wall = np.hypot(x, y) > 0.5 * np.hypot(x, y).max()
    staves = [mesh.vertices[wall & np.isin(sector, (k, (k + 1) % 48))] for k in range(48)]
    if any(len(stave) != 8 for stave in staves):
        with tempfile.TemporaryDirectory() as cache:
            return decompose(mesh, RectifyConfig(), Path(cache)).hulls
    return tuple(make_bounded_hull(points, 64, 0.0) for points in (mesh.vertices[z < z.min() + 0.005], *staves))


RED, BLUE, WHITE = (200, 30, 30), (30, 60, 200), (235, 235, 235)


def kitchen() -> SettledScene:
    """Seven things with room between them: containers, flat tops, twins that only colour or place tells apart."""
    return settled(
        [
            Thing("bowl", vessel(0.075, 0.06, color=WHITE), -0.25, 0.1),
            Thing("mug", vessel(0.035, 0.09, color=RED), 0.2, -0.1),
            Thing("mug", vessel(0.035, 0.09, color=BLUE), 0.2, 0.15),
            Thing("plate", cylinder(0.11, 0.012, color=WHITE), 0.0, -0.15),
            Thing("lemon", ball(0.028, (240, 220, 40)), -0.05, 0.15),
            Thing("cracker box", box(0.06, 0.16, 0.2, (200, 60, 40)), -0.35, -0.15),
            Thing("wooden block", box(0.05, 0.05, 0.05), 0.38, 0.0),
        ]
    )
