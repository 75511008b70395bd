"""Who carries whom by force, on things whose statics are plain."""

import numpy as np
import pytest
import trimesh

from schemas.config import SettleConfig
from schemas.geometry import ConvexPieces, Pose, TriangleMesh
from schemas.objects import PlacedObject, PlacedObjects, Table
from tableverse_factory.evaluation.bench.release import ReleasedScene, at_rest, scene_at
from tableverse_factory.evaluation.bench.support_by_force import carried_by_force
from tableverse_factory.geometry.mesh.meshes import from_trimesh

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def scene(*things: tuple[TriangleMesh, Pose]) -> ReleasedScene:
    table = Table(np.zeros(2), np.ones(2), 0.0, (200, 200, 200), 0.0)
    objects = tuple(
        PlacedObject(f"o_{k}", "thing", 1.0, mesh, 1.0, pose, None) for k, (mesh, pose) in enumerate(things)
    )
    pieces = [ConvexPieces((placed.mesh,), 1.0, 0.0, "convex") for placed in objects]
    item = PlacedObjects("scene", table, objects, None)
    ended, resting = at_rest(scene_at(item, pieces, [placed.pose for placed in objects]), SettleConfig(), gentle=True)
    assert resting
    return ended


def box(size: tuple[float, float, float], at: tuple[float, float, float], tilt_deg: float = 0.0):
    half = np.radians(tilt_deg) / 2
    pose = Pose(np.array(at), np.array([np.cos(half), 0.0, np.sin(half), 0.0]))
    return from_trimesh(trimesh.creation.box(size)), pose


def test_a_stack_is_carried_and_what_stands_beside_it_is_not() -> None:
    found = carried_by_force(
        scene(
            box((0.2, 0.1, 0.05), (0, 0, 0.025)),
            box((0.1, 0.1, 0.05), (0, 0, 0.0755)),
            box((0.05, 0.1, 0.05), (0.1252, 0, 0.025)),
        ),
        0.002,
    )
    assert found == {(1, 0)}


def test_a_plank_across_two_blocks_is_carried_by_both() -> None:
    left, right = box((0.04, 0.04, 0.06), (-0.1, 0, 0.03)), box((0.04, 0.04, 0.06), (0.1, 0, 0.03))
    assert carried_by_force(scene(left, right, box((0.3, 0.05, 0.01), (0, 0, 0.0655))), 0.002) == {(2, 0), (2, 1)}


@pytest.mark.parametrize(("tilt", "carried"), [(30.0, {(1, 0)}), (75.0, set())])
def test_what_leans_is_carried_as_far_as_its_weight_is_borne(tilt: float, carried: set[tuple[int, int]]) -> None:
    """A board with one edge on the table that leans on a heavy block: the steeper, the less the block bears."""
    angle = np.radians(tilt)
    along, normal = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    edge = np.array([0.0, 0.1])  # of the block; the board's lower face touches it 0.2 m up its length or at its top
    foot = edge - along * min(0.2, 0.1 / np.sin(angle))
    middle = foot + 0.12 * along + 0.0045 * normal
    block = box((0.2, 0.3, 0.1), (0.1, 0, 0.05))
    board = box((0.24, 0.1, 0.008), (float(middle[0]), 0.0, float(middle[1])), -tilt)
    assert carried_by_force(scene(block, board), 0.002) == carried
