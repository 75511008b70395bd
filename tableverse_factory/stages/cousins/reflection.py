"""Mirror images of things and scenes, across the vertical plane through the table's middle."""

from dataclasses import replace

import numpy as np

from schemas.geometry import ConvexPieces, Texture, TriangleMesh
from schemas.objects import PlacedObject, Table
from tableverse_factory.geometry.math.transforms import pose_from_rotation, quaternion_about_z, rotation_matrix

_ACROSS = np.diag([-1.0, 1.0, 1.0])


def mirror_object(item: PlacedObject, table: Table) -> PlacedObject:
    """Mirror an object across the plane that holds the table's middle and its y axis.

    The mesh is mirrored in its own frame, and the pose follows: the rotation stays one.
    """
    axes = rotation_matrix(quaternion_about_z(table.yaw))
    across = axes @ _ACROSS @ axes.T
    middle = np.array([*table.center_xy, 0.0])
    rotation = across @ rotation_matrix(item.pose.quaternion_wxyz) @ _ACROSS
    position = across @ (item.pose.position - middle) + middle
    return replace(
        item,
        mesh=mirror_mesh(item.mesh),
        pieces=None if item.pieces is None else mirror_pieces(item.pieces),
        pose=pose_from_rotation(position, rotation),
    )


def mirror_mesh(mesh: TriangleMesh) -> TriangleMesh:
    """Mirror a mesh across x = 0, its faces still counter-clockwise from outside."""
    texture = mesh.texture
    if texture is not None:
        texture = Texture(texture.picture, texture.corner_uv[:, ::-1])
    return replace(mesh, vertices=mesh.vertices @ _ACROSS, faces=mesh.faces[:, ::-1], texture=texture)


def mirror_pieces(pieces: ConvexPieces) -> ConvexPieces:
    """Mirror convex pieces across x = 0."""
    return replace(pieces, hulls=tuple(map(mirror_mesh, pieces.hulls)))
