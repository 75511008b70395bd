"""Orientations of a placed object: turned about the vertical on its present face, or stood on its end."""

from dataclasses import dataclass, replace

import numpy as np

from schemas.geometry import Frozen, Quaternion, TriangleMesh
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.transforms import (
    multiply_quaternions,
    quaternion_about_z,
    quaternion_from_matrix,
    rotation_angle,
    rotation_matrix,
)
from tableverse_factory.geometry.mesh.height_maps import (
    HeightMap,
    compute_column_center,
    compute_height_map,
    rotate_quarter_turn,
)
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene
from tableverse_factory.geometry.relations.relations import BodyFeatures, compute_outline
from tableverse_factory.geometry.relations.stand_upright import find_upright_rotation

_QUARTERS = 4
_IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
_UPSIDE_DOWN = np.array([0.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class Orientation(Frozen):
    """Rotation from the object's present to its future orientation, about the table's origin."""

    quaternion_wxyz: Quaternion
    angle: float  # 0 to pi [rad]
    body: BodyFeatures  # the rotated object, without its cavity and flat top


def list_orientations(standing: TriangleMesh, body: BodyFeatures) -> tuple[Orientation, ...]:
    """List eight headings of an object in the table frame, by angle, from its map and one at 45 degrees."""
    eighth = quaternion_about_z(np.pi / _QUARTERS)
    found = [
        *_list_quarter_turns(body.heights, standing, _IDENTITY),
        *_rotate_mesh(standing, eighth, body.heights.cell),
    ]
    return tuple(sorted(found, key=lambda turn: turn.angle))


def list_upright_orientations(standing: TriangleMesh, cell: float) -> tuple[Orientation, ...]:
    """List eight orientations that stand a long object on either end; none where it has no distinct long axis."""
    rotation = find_upright_rotation(standing)
    if rotation is None:
        return ()
    upright = quaternion_from_matrix(rotation)
    found = [
        *_rotate_mesh(standing, upright, cell),
        *_rotate_mesh(standing, multiply_quaternions(_UPSIDE_DOWN, upright), cell),
    ]
    return tuple(sorted(found, key=lambda turn: turn.angle))


def _rotate_mesh(standing: TriangleMesh, quaternion_wxyz: Quaternion, cell: float) -> list[Orientation]:
    mesh = replace(standing, vertices=standing.vertices @ rotation_matrix(quaternion_wxyz).T)
    return _list_quarter_turns(compute_height_map(mesh, make_raycasting_scene(mesh), cell), mesh, quaternion_wxyz)


def _list_quarter_turns(heights: HeightMap, mesh: TriangleMesh, start: Quaternion) -> list[Orientation]:
    """List four headings of a mesh that was rotated by `start` already."""
    (low, high), outline = aabb(mesh.vertices), compute_outline(mesh.vertices[:, :2])
    found = []
    for quarter in range(_QUARTERS):
        rotation = multiply_quaternions(quaternion_about_z(quarter * np.pi / 2), start)
        body = BodyFeatures(
            low, high, outline, compute_column_center(heights), heights, None, np.zeros_like(heights.filled)
        )
        found.append(Orientation(rotation, rotation_angle(_IDENTITY, rotation), body))
        # (x, y) goes to (-y, x)
        low, high = np.array([-high[1], low[0], low[2]]), np.array([-low[1], high[0], high[2]])
        outline = np.stack([-outline[:, 1], outline[:, 0]], axis=1)
        heights = rotate_quarter_turn(heights)
    return found
