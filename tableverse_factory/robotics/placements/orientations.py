"""An object turned about the vertical on the face that it rests on now; or stood on its end, to go into a vessel."""

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
    column_caster,
    column_center,
    height_map,
    turned_quarter,
)
from tableverse_factory.geometry.relations.relations import BodyFeatures, outline_of
from tableverse_factory.geometry.relations.stand_upright import end_rotation

_QUARTERS = 4
_AS_IT_IS = np.array([1.0, 0.0, 0.0, 0.0])
_OVER = np.array([0.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class Turn(Frozen):
    """A way to hold the object.

    Attributes:
        quaternion_wxyz: From how it stands to how it would, about the table's origin.
        angle: Of that rotation, 0 to pi [rad].
        body: Turned about the table's origin; without its cavity and flat top, which nobody asks for here.
    """

    quaternion_wxyz: Quaternion
    angle: float
    body: BodyFeatures


def turns(standing: TriangleMesh, body: BodyFeatures) -> tuple[Turn, ...]:
    """Eight headings, as it stands first: its map in quarter turns, and measured anew half a quarter further.

    Args:
        standing: The mesh in the table frame.
        body: The same, measured.
    """
    eighth = quaternion_about_z(np.pi / _QUARTERS)
    found = [*_quarters(body.heights, standing, _AS_IT_IS), *_turned(standing, eighth, body.heights.cell)]
    return tuple(sorted(found, key=lambda turn: turn.angle))


def turns_on_end(standing: TriangleMesh, cell: float) -> tuple[Turn, ...]:
    """Eight ways to hold a long object upright, either end up; none where no axis of it stands out."""
    rotation = end_rotation(standing)
    if rotation is None:
        return ()
    upright = quaternion_from_matrix(rotation)
    found = [*_turned(standing, upright, cell), *_turned(standing, multiply_quaternions(_OVER, upright), cell)]
    return tuple(sorted(found, key=lambda turn: turn.angle))


def _turned(standing: TriangleMesh, quaternion_wxyz: Quaternion, cell: float) -> list[Turn]:
    mesh = replace(standing, vertices=standing.vertices @ rotation_matrix(quaternion_wxyz).T)
    return _quarters(height_map(mesh, column_caster(mesh), cell), mesh, quaternion_wxyz)


def _quarters(heights: HeightMap, mesh: TriangleMesh, start: Quaternion) -> list[Turn]:
    """Four headings of a mesh that was turned by `start` already."""
    (low, high), outline = aabb(mesh.vertices), outline_of(mesh.vertices[:, :2])
    found = []
    for quarter in range(_QUARTERS):
        rotation = multiply_quaternions(quaternion_about_z(quarter * np.pi / 2), start)
        body = BodyFeatures(low, high, outline, column_center(heights), heights, None, np.zeros_like(heights.filled))
        found.append(Turn(rotation, rotation_angle(_AS_IT_IS, rotation), body))
        # (x, y) goes to (-y, x)
        low, high = np.array([-high[1], low[0], low[2]]), np.array([-low[1], high[0], high[2]])
        outline = np.stack([-outline[:, 1], outline[:, 0]], axis=1)
        heights = turned_quarter(heights)
    return found
