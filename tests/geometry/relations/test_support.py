"""Who carries whom, on solids whose truth is plain: meshes and pieces say the same."""

import numpy as np
import pytest
import trimesh

from schemas.geometry import ConvexPieces, Pose, TriangleMesh
from tableverse_factory.geometry.collision.solids import place_pieces
from tableverse_factory.geometry.mesh.meshes import from_trimesh, place_mesh
from tableverse_factory.geometry.relations.support import Pairs, find_mesh_support, find_piece_support

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
Standing = tuple[TriangleMesh, Pose]


def solid(mesh: trimesh.Trimesh, x: float, y: float, z: float, quaternion=UPRIGHT) -> Standing:
    """`z` is the height of the middle."""
    return from_trimesh(mesh), Pose(np.array([x, y, z]), np.array(quaternion, dtype=float))


def box(size, x: float, y: float, z: float, quaternion=UPRIGHT) -> Standing:
    return solid(trimesh.creation.box(size), x, y, z, quaternion)


def carried(*things: Standing) -> Pairs:
    """What meshes and pieces agree upon; each thing is convex."""
    on_meshes = find_mesh_support([place_mesh(*thing) for thing in things])
    on_pieces = find_piece_support(
        [place_pieces(ConvexPieces((mesh,), 1.0, 0.0, ""), pose, 1.0) for mesh, pose in things]
    )
    assert on_meshes == on_pieces
    return on_meshes


@pytest.mark.parametrize("gap", [0.0, 0.0015, -0.0015])
def test_a_stack_is_carried_from_below_touching_hovering_or_sunk_in_a_little(gap: float) -> None:
    low, high = box((0.2, 0.1, 0.05), 0, 0, 0.025), box((0.1, 0.1, 0.05), 0.02, 0, 0.075 + gap)
    assert carried(low, high) == {(1, 0)}
    assert carried(high, low) == {(0, 1)}


def test_what_hovers_or_stands_beside_is_not_carried() -> None:
    low = box((0.2, 0.1, 0.05), 0, 0, 0.025)
    assert carried(low, box((0.1, 0.1, 0.05), 0, 0, 0.085)) == set()
    assert carried(low, box((0.2, 0.1, 0.05), 0.2005, 0, 0.025)) == set()
    assert carried(low, box((0.05, 0.1, 0.2), 0.126, 0, 0.1)) == set()
    assert carried(low) == set()


def test_a_plank_is_carried_by_both_ends_and_carries_what_stands_on_it() -> None:
    left, right = box((0.04, 0.04, 0.06), -0.1, 0, 0.03), box((0.04, 0.04, 0.06), 0.1, 0, 0.03)
    plank = box((0.3, 0.05, 0.01), 0, 0, 0.0655)
    ball = solid(trimesh.creation.icosphere(4, 0.02), 0, 0, 0.091)
    assert carried(left, right, plank, ball) == {(2, 0), (2, 1), (3, 2)}


@pytest.mark.parametrize(("degrees_from_flat", "holds"), [(40.0, True), (80.0, False)])
def test_leaning_counts_as_carried_only_where_it_rests_more_than_it_leans(
    degrees_from_flat: float, holds: bool
) -> None:
    angle = np.deg2rad(degrees_from_flat)
    block = box((0.1, 0.1, 0.1), 0.0, 0, 0.05)
    # A board over the block's upper edge at (-0.05, 0.1), its lower face on the edge.
    along, normal = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    x, z = np.array([-0.05, 0.1]) + 0.0055 * normal - 0.01 * along
    board = box((0.12, 0.05, 0.01), x, 0, z, (np.cos(angle / 2), 0.0, -np.sin(angle / 2), 0.0))
    assert carried(block, board) == ({(1, 0)} if holds else set())


def test_nested_bowls_carry_one_another_on_their_meshes() -> None:
    line = [(0, 0), (0.04, 0), (0.08, 0.06), (0.076, 0.06), (0.038, 0.004), (0, 0.004)]
    bowl = from_trimesh(trimesh.creation.revolve(np.array(line), sections=64))
    upper = place_mesh(bowl, Pose(np.array([0.0, 0.0, 0.0045]), np.array(UPRIGHT)))
    assert find_mesh_support([bowl, upper]) == {(1, 0)}
