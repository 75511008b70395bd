"""Support by contact force, on objects whose statics are plain."""

import numpy as np
import pytest
import trimesh

from schemas.config import SettleConfig
from schemas.geometry import ConvexPieces, Pose, TriangleMesh
from schemas.objects import PlacedObject, PlacedObjects, Table
from tableverse_factory.evaluation.bench.free_simulation import ReleasedScene, make_scene, simulate_to_rest
from tableverse_factory.evaluation.bench.support_by_force import find_support_by_force
from tableverse_factory.geometry.mesh.meshes import from_trimesh


def settle(*solids: tuple[TriangleMesh, Pose]) -> ReleasedScene:
    table = Table(np.zeros(2), np.ones(2), 0.0, (200, 200, 200), 0.0)
    objects = tuple(PlacedObject(f"o_{k}", "box", 1.0, mesh, 1.0, pose, None) for k, (mesh, pose) in enumerate(solids))
    pieces = [ConvexPieces((placed.mesh,), 1.0, 0.0, "convex") for placed in objects]
    scene = make_scene(PlacedObjects("scene", table, objects, None), pieces, [placed.pose for placed in objects])
    settled, resting = simulate_to_rest(scene, SettleConfig(), gentle=True)
    assert resting
    return settled


def box(size: tuple[float, float, float], at: tuple[float, float, float], tilt_deg: float = 0.0):
    half = np.radians(tilt_deg) / 2
    pose = Pose(np.array(at), np.array([np.cos(half), 0.0, np.sin(half), 0.0]))
    return from_trimesh(trimesh.creation.box(size)), pose


def test_a_stacked_box_is_carried_and_its_neighbour_is_not() -> None:
    found = find_support_by_force(
        settle(
            box((0.2, 0.1, 0.05), (0, 0, 0.025)),
            box((0.1, 0.1, 0.05), (0, 0, 0.0755)),
            box((0.05, 0.1, 0.05), (0.1252, 0, 0.025)),
        ),
        0.002,
    )
    assert found == {(1, 0)}


def test_a_plank_across_two_blocks_is_carried_by_both() -> None:
    left, right = box((0.04, 0.04, 0.06), (-0.1, 0, 0.03)), box((0.04, 0.04, 0.06), (0.1, 0, 0.03))
    assert find_support_by_force(settle(left, right, box((0.3, 0.05, 0.01), (0, 0, 0.0655))), 0.002) == {(2, 0), (2, 1)}


@pytest.mark.parametrize(("tilt", "carried"), [(30.0, {(1, 0)}), (75.0, set())])
def test_a_leaning_board_is_carried_if_the_block_bears_its_weight(tilt: float, carried: set[tuple[int, int]]) -> None:
    """A board with one edge on the table leans on a heavy block: the steeper it is, the less the block bears."""
    angle = np.radians(tilt)
    along, normal = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    edge = np.array([0.0, 0.1])  # of the block; the board's lower face touches it 0.2 m up its length or at its top
    foot = edge - along * min(0.2, 0.1 / np.sin(angle))
    middle = foot + 0.12 * along + 0.0045 * normal
    block = box((0.2, 0.3, 0.1), (0.1, 0, 0.05))
    board = box((0.24, 0.1, 0.008), (float(middle[0]), 0.0, float(middle[1])), -tilt)
    assert find_support_by_force(settle(block, board), 0.002) == carried
