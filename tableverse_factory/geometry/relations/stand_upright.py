"""Long objects turned upright, as pens stand in cups."""

from dataclasses import replace

import numpy as np

from schemas.geometry import Matrix3, TriangleMesh
from tableverse_factory.geometry.mesh.meshes import box_center

_MIN_ELONGATION = 2.0


def find_upright_rotation(mesh: TriangleMesh) -> Matrix3 | None:
    """Find a rotation that makes the longest axis of a mesh vertical; None where no axis stands out."""
    centered = mesh.vertices - box_center(mesh)
    values, axes = np.linalg.eigh(centered.T @ centered)
    if values[2] <= _MIN_ELONGATION**2 * values[1]:
        return None
    return (axes * np.sign(np.linalg.det(axes))).T


def stand_upright(mesh: TriangleMesh) -> TriangleMesh | None:
    """Turn a mesh so that its longest axis is vertical and it stands at z = 0; None where no axis stands out."""
    rotation, middle = find_upright_rotation(mesh), box_center(mesh)
    if rotation is None:
        return None
    vertices = (mesh.vertices - middle) @ rotation.T
    vertices[:, 2] -= vertices[:, 2].min()
    return replace(mesh, vertices=vertices + middle * [1.0, 1.0, 0.0])
