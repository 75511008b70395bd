"""Edges behind which a surface goes on are found, and slanting surfaces have none."""

import numpy as np
import pytest
import trimesh

from schemas.geometry import Camera, Pose
from tableverse_factory.geometry.math.transforms import identity_pose
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.mesh.occluding_edges import find_behind_edges
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene

CAMERA = Camera(200.0, 200.0, 49.5, 49.5, 100, 100)


def build_board(depth: float, half: float, lean: float = 0.0) -> trimesh.Trimesh:
    board = trimesh.creation.box((2 * half, 2 * half, 0.001))
    board.apply_transform(trimesh.transformations.rotation_matrix(lean, [0.0, 1.0, 0.0]))
    board.apply_translation([0.0, 0.0, depth])
    return board


OWN = np.ones((100, 100), dtype=bool)  # a hundred pixels wide: edges are missed by three


def test_pixels_near_a_step_lie_behind_an_edge() -> None:
    scene = make_raycasting_scene(from_trimesh(build_board(0.5, 0.05)), from_trimesh(build_board(0.55, 1.0)))
    behind = find_behind_edges(scene, CAMERA, identity_pose(), OWN)
    row = np.flatnonzero(behind[50])  # the near board covers columns 30 to 69
    np.testing.assert_array_equal(row, [*range(27, 30), *range(70, 73)])


@pytest.mark.parametrize("lean_deg", [0.0, 55.0, 65.0, 75.0])
@pytest.mark.parametrize(("focal_px", "depth"), [(200.0, 0.5), (577.0, 1.0), (577.0, 3.0)])
def test_neither_slanting_surfaces_nor_outlines_have_edges(lean_deg: float, focal_px: float, depth: float) -> None:
    camera = Camera(focal_px, focal_px, 49.5, 49.5, 100, 100)
    scene = make_raycasting_scene(from_trimesh(build_board(depth, 0.4 * 50 / focal_px * depth, np.deg2rad(lean_deg))))
    assert not find_behind_edges(scene, camera, identity_pose(), OWN).any()


def test_the_scene_may_have_another_frame() -> None:
    boards = [build_board(0.5, 0.05), build_board(0.55, 1.0)]
    for board in boards:
        board.apply_translation([0.3, -0.2, 1.0])
    scene = make_raycasting_scene(*map(from_trimesh, boards))
    pose = Pose(np.array([0.3, -0.2, 1.0]), np.array([1.0, 0.0, 0.0, 0.0]))
    assert find_behind_edges(scene, CAMERA, pose, OWN)[50, 29]
