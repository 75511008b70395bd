"""Simple bodies on the table, and the arm's gripper."""

import numpy as np
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.mesh.meshes import from_trimesh


def standing(mesh: trimesh.Trimesh, at=(0.0, 0.0)) -> TriangleMesh:
    """Put down at a place on the table."""
    mesh = mesh.copy()
    mesh.apply_translation([*at, -mesh.bounds[0, 2]])
    return from_trimesh(mesh)


def box(x: float, y: float, z: float) -> TriangleMesh:
    return standing(trimesh.creation.box([x, y, z]).subdivide().subdivide())


def cup(radius: float = 0.04, height: float = 0.09, wall: float = 0.004) -> TriangleMesh:
    """A vessel of revolution, open at the top."""
    profile = [(0, 0), (radius, 0), (radius, height), (radius - wall, height), (radius - wall, wall), (0, wall)]
    return standing(trimesh.creation.revolve(profile, sections=64))


def middle(mesh: TriangleMesh) -> np.ndarray:
    return (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
