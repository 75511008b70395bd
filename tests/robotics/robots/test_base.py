"""Places for the base: clear of everything, wholly on the table or beside it, and within reach."""

import mujoco
import numpy as np
import pytest

from schemas.geometry import Pose
from schemas.objects import Table
from tableverse_factory.core.errors import InputError
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.robotics.robots.base import BASE_SPACING_M, ELBOW_MARGIN_M, find_bases
from tableverse_factory.robotics.robots.gripper_clearance import LIFT_M
from tableverse_factory.robotics.robots.panda import build_panda
from tableverse_factory.robotics.robots.reach import CELL_M, compute_reach_map
from tableverse_factory.robotics.robots.station import Station
from tests.helpers.blocks_on_table import WIDE_TABLE, block_files

BLOCKS = [((0.05, 0.05, 0.08), (0.0, 0.1)), ((0.06, 0.03, 0.04), (0.12, -0.05)), ((0.04, 0.04, 0.12), (-0.15, 0.0))]
TARGETS = np.array([[0.0, 0.1, 0.06], [0.12, -0.05, 0.03], [-0.15, 0.0, 0.1]])
ARM = build_panda()


def distance_to_block(foot: np.ndarray, block: tuple[tuple[float, ...], tuple[float, float]]) -> float:
    size, at = block
    return float(np.linalg.norm(np.maximum(np.abs(foot - np.array(at)) - np.array(size[:2]) / 2, 0.0)))


def facing(pose: Pose) -> np.ndarray:
    return rotation_matrix(pose.quaternion_wxyz)[:2, 0]


def test_bases_reach_stand_clear_and_face_their_targets() -> None:
    station = Station(block_files(BLOCKS, table=WIDE_TABLE), ARM)
    before = station.base
    found = find_bases(station, TARGETS)
    assert len(found) == 8
    np.testing.assert_allclose(station.base.position, before.position)
    assert station.model.body_pos[station.base_body].tolist() == before.position.tolist()
    middle = (TARGETS[:, :2].min(axis=0) + TARGETS[:, :2].max(axis=0)) / 2
    for index, pose in enumerate(found):
        foot = pose.position[:2]
        assert pose.position[2] == 0.0
        assert min(distance_to_block(foot, block) for block in BLOCKS) >= ARM.base_radius_m + ELBOW_MARGIN_M - 1e-6
        toward = (middle - foot) / np.linalg.norm(middle - foot)
        np.testing.assert_allclose(facing(pose), toward, atol=1e-9)
        apart = [np.linalg.norm(foot - other.position[:2]) for other in found[:index]]
        assert min(apart, default=1.0) >= BASE_SPACING_M
        inside = 0.7 - np.abs(foot).max()
        assert inside >= ARM.base_radius_m or inside <= -station.pedestal_radius_m


def test_the_viewer_s_side_comes_first_where_all_sides_are_alike() -> None:
    files = block_files([((0.05, 0.05, 0.05), (0.0, 0.0))], table=WIDE_TABLE)
    first = find_bases(Station(files, ARM), np.array([[0.0, 0.0, 0.03]]))[0]
    np.testing.assert_allclose(facing(first), [0.0, 1.0], atol=1e-9)


def test_from_the_best_base_the_arm_really_gets_there() -> None:
    station = Station(block_files(BLOCKS, table=WIDE_TABLE), ARM)
    best = find_bases(station, TARGETS)[0]
    reach = compute_reach_map(ARM)
    for target in TARGETS:
        for height in (target[2], target[2] + LIFT_M):
            distance = np.linalg.norm(target[:2] - best.position[:2])
            assert reach.margin(np.array([distance]), np.array([height]))[0] > 0.05


def test_a_crowded_table_has_its_base_beside_it() -> None:
    grid = [((0.04, 0.04, 0.05), (x, y)) for x in (-0.2, -0.07, 0.07, 0.2) for y in (-0.15, 0.0, 0.15)]
    table = Table(np.zeros(2), np.array([0.3, 0.25]), 0.4, (150, 120, 90), 0.0)
    station = Station(block_files(grid, table=table), ARM)
    found = find_bases(station, np.array([[0.0, 0.0, 0.05], [0.07, 0.0, 0.05]]))
    assert found
    turn = np.array([[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]])
    for pose in found:
        along = np.abs(turn @ pose.position[:2]) - table.half_size_xy
        assert np.linalg.norm(np.maximum(along, 0.0)) > station.pedestal_radius_m


def test_the_same_question_has_the_same_answer() -> None:
    files = block_files(BLOCKS, table=WIDE_TABLE)
    first, second = (find_bases(Station(files, ARM), TARGETS) for _ in range(2))
    assert [pose.position.tobytes() for pose in first] == [pose.position.tobytes() for pose in second]
    assert [pose.quaternion_wxyz.tobytes() for pose in first] == [pose.quaternion_wxyz.tobytes() for pose in second]


@pytest.mark.parametrize("targets", [[[-0.8, 0.0, 0.1], [0.8, 0.0, 0.1]], [[0.0, 0.0, 1.5]]])
def test_what_no_base_reaches_has_none(targets: list[list[float]]) -> None:
    assert find_bases(Station(block_files(BLOCKS, table=WIDE_TABLE), ARM), np.array(targets)) == []


def test_no_targets_and_no_table_are_errors() -> None:
    station = Station(block_files(BLOCKS), ARM)
    with pytest.raises(ValueError, match="no targets"):
        find_bases(station, np.zeros((0, 3)))
    files = block_files(BLOCKS)
    bare = {**files, "scene.xml": files["scene.xml"].replace(b'body name="table"', b'body name="board"')}
    with pytest.raises(InputError, match="'table'"):
        find_bases(Station(bare, ARM), TARGETS)


def test_the_map_of_reach_is_that_of_a_panda() -> None:
    reach = compute_reach_map(ARM)
    low = np.flatnonzero(reach.cells[:, round(0.05 / CELL_M)]) * CELL_M
    assert 0.25 <= low.min() <= 0.4
    assert 0.7 <= low.max() <= 0.85  # its span is 0.855 m from the shoulder, and the gripper points down
    assert reach.margin(np.array([0.55, 0.1, 1.4]), np.array([0.1, 0.1, 0.1])).tolist()[1:] == [0.0, 0.0]
    assert reach.margin(np.array([0.55]), np.array([0.1]))[0] >= 0.2
    data = mujoco.MjData(ARM.spec().compile())
    assert data.model.nq == 9
