"""Mirror images of things, across the vertical plane through the table's middle.

A thing whose own shape is a mirror image of itself keeps its mesh and is turned instead, so that print stays legible.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from schemas.geometry import ConvexPieces, Matrix3, Texture, TriangleMesh, Vector3
from schemas.objects import PlacedObject, Table
from tableverse_factory.geometry.math.aabb import aabb_size
from tableverse_factory.geometry.math.transforms import pose_from_rotation, quaternion_about_z, rotation_matrix
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene, to_tensor

SYMMETRIC = 0.015  # distance of nearly all of a shape from its own mirror image, over its longest side
NEARLY_ALL = 97.0  # percent
MAX_SLOPE = 0.3  # largest vertical part of the normal of such a plane: things stay upright
_POINTS = 600  # of a shape that are compared
_ACROSS = np.diag([-1.0, 1.0, 1.0])


def mirror_object(item: PlacedObject, table: Table) -> PlacedObject:
    """Mirror an object across the plane that holds the table's middle and its y axis.

    The mesh is mirrored in its own frame, unless it is symmetric, and the pose follows: the rotation stays one.
    """
    axes = rotation_matrix(quaternion_about_z(table.yaw))
    across = axes @ _ACROSS @ axes.T
    middle = np.array([*table.center_xy, 0.0])
    rotation = rotation_matrix(item.pose.quaternion_wxyz)
    plane = _find_own_plane(item.mesh, rotation, axes[:, 0])
    if plane is None:
        mirrored = replace(item, mesh=mirror_mesh(item.mesh), pieces=_mirror_pieces(item.pieces))
        own, shift = _ACROSS, np.zeros(3)
    else:
        normal, offset = plane
        mirrored, own = item, np.eye(3) - 2.0 * np.outer(normal, normal)
        shift = 2.0 * offset * item.scale * rotation @ normal
    position = across @ (item.pose.position + shift - middle) + middle
    return replace(mirrored, pose=pose_from_rotation(position, across @ rotation @ own))


def mirror_mesh(mesh: TriangleMesh) -> TriangleMesh:
    """Mirror a mesh across x = 0, its faces still counter-clockwise from outside."""
    texture = mesh.texture
    if texture is not None:
        texture = Texture(texture.picture, texture.corner_uv[:, ::-1])
    return replace(mesh, vertices=mesh.vertices @ _ACROSS, faces=mesh.faces[:, ::-1], texture=texture)


def _mirror_pieces(pieces: ConvexPieces | None) -> ConvexPieces | None:
    return None if pieces is None else replace(pieces, hulls=tuple(map(mirror_mesh, pieces.hulls)))


def _find_own_plane(mesh: TriangleMesh, rotation: Matrix3, across: Vector3) -> tuple[Vector3, float] | None:
    """Find an upright plane of symmetry in the mesh's frame, as normal and offset [m]; None where there is none.

    Of several, the one that turns the thing least.
    """
    points = mesh.vertices[:: max(1, len(mesh.vertices) // _POINTS)]
    surface, allowed = make_raycasting_scene(mesh), SYMMETRIC * float(aabb_size(mesh.vertices).max())
    for normal in sorted(_list_axes(mesh, rotation), key=lambda axis: -abs(float(across @ rotation @ axis))):
        along = mesh.vertices @ normal
        offset = float(along.min() + along.max()) / 2
        image = points - 2.0 * (points @ normal - offset)[:, None] * normal
        apart = surface.compute_distance(to_tensor(image), nthreads=1).numpy()
        if float(np.percentile(apart, NEARLY_ALL)) <= allowed:
            return normal, offset
    return None


def _list_axes(mesh: TriangleMesh, rotation: Matrix3) -> Iterator[Vector3]:
    """List normals that planes of symmetry may have: the mesh's own axes, and the main ones of its vertices."""
    _, main = np.linalg.eigh(np.cov(mesh.vertices.T))
    for axis in (*np.eye(3), *main.T):
        if abs(float((rotation @ axis)[2])) <= MAX_SLOPE:
            yield axis
