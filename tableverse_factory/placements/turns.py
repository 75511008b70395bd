"""An object turned about the vertical, on the face that it rests on now."""

from dataclasses import dataclass, replace

import numpy as np

from schemas.geometry import Frozen, Quaternion, TriangleMesh
from tableverse_factory.geometry.boxes import box_around
from tableverse_factory.geometry.height_maps import HeightMap, caster_of, column_center, height_map, turned_quarter
from tableverse_factory.geometry.relations import Body, outline_of
from tableverse_factory.geometry.transforms import quaternion_about_z, rotation_matrix

_QUARTERS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Turn(Frozen):
    """A heading.

    Attributes:
        quaternion_wxyz: From how it stands to how it would, about the table's origin.
        angle: Of that rotation, 0 to pi [rad].
        body: Turned about the table's origin; without its cavity and flat top, which nobody asks for here.
    """

    quaternion_wxyz: Quaternion
    angle: float
    body: Body


def turns(standing: TriangleMesh, body: Body) -> tuple[Turn, ...]:
    """Eight headings, as it stands first: its map in quarter turns, and measured anew half a quarter further.

    Args:
        standing: The mesh in the table frame.
        body: The same, measured.
    """
    eighth = np.pi / _QUARTERS
    diagonal = replace(standing, vertices=standing.vertices @ rotation_matrix(quaternion_about_z(eighth)).T)
    heights = height_map(diagonal, caster_of(diagonal), body.heights.cell)
    found = [*_quarters(body.heights, standing, 0.0), *_quarters(heights, diagonal, eighth)]
    return tuple(sorted(found, key=lambda turn: turn.angle))


def _quarters(heights: HeightMap, mesh: TriangleMesh, start: float) -> list[Turn]:
    (low, high), outline = box_around(mesh.vertices), outline_of(mesh.vertices[:, :2])
    found = []
    for quarter in range(_QUARTERS):
        yaw = start + quarter * np.pi / 2
        yaw -= 2 * np.pi if yaw > np.pi + 1e-9 else 0.0
        body = Body(low, high, outline, column_center(heights), heights, None, np.zeros_like(heights.filled))
        found.append(Turn(quaternion_about_z(yaw), abs(yaw), body))
        # (x, y) goes to (-y, x)
        low, high = np.array([-high[1], low[0], low[2]]), np.array([-low[1], high[0], high[2]])
        outline = np.stack([-outline[:, 1], outline[:, 0]], axis=1)
        heights = turned_quarter(heights)
    return found
