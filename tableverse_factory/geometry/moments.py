"""Volume, centre and second moments of what a closed mesh encloses."""

import numpy as np

from schemas.geometry import Matrix3, TriangleMesh, Vector3
from tableverse_factory.geometry.boxes import box_around


def volume_integrals(mesh: TriangleMesh) -> tuple[float, Vector3, Matrix3]:
    """Volume [m³], centre [m] and second moments of volume about the centre [m⁵] of a closed mesh.

    Sums signed tetrahedra from the middle of the box: exact for polyhedra.
    """
    low, high = box_around(mesh.vertices)
    middle = (low + high) / 2
    corners = mesh.vertices[mesh.faces] - middle
    six_volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    volume = float(six_volumes.sum() / 6)
    if volume == 0.0:
        return 0.0, middle, np.zeros((3, 3))
    total = corners.sum(axis=1)
    center = (six_volumes @ total) / (24 * volume)
    outer = np.einsum("i,ij,ik->jk", six_volumes, total, total)
    outer += np.einsum("i,icj,ick->jk", six_volumes, corners, corners)
    return volume, middle + center, outer / 120 - volume * np.outer(center, center)
