"""Long things stood on their end: pens go into cups that way."""

from dataclasses import replace

import numpy as np

from schemas.geometry import Matrix3, TriangleMesh
from tableverse_factory.geometry.mesh.meshes import box_center

_LONG = 2.0


def end_rotation(mesh: TriangleMesh) -> Matrix3 | None:
    """The rotation that makes the longest axis of a mesh vertical, either end up; None where no axis stands out."""
    centered = mesh.vertices - box_center(mesh)
    values, axes = np.linalg.eigh(centered.T @ centered)
    if values[2] <= _LONG**2 * values[1]:
        return None
    rotation: Matrix3 = (axes * np.sign(np.linalg.det(axes))).T
    return rotation


def stood_on_end(mesh: TriangleMesh) -> TriangleMesh | None:
    """The mesh turned so that its longest axis is vertical, standing at z = 0; None where no axis stands out."""
    rotation, middle = end_rotation(mesh), box_center(mesh)
    if rotation is None:
        return None
    vertices = (mesh.vertices - middle) @ rotation.T
    vertices[:, 2] -= vertices[:, 2].min()
    return replace(mesh, vertices=vertices + middle * [1.0, 1.0, 0.0])
