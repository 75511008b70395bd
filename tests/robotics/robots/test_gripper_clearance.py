"""Room for the gripper, against what an exact collision test of the same solids says."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.config import TrajectoriesConfig
from schemas.geometry import TriangleMesh
from schemas.trajectories import Grasps
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.relations.antipodal import sample_inward_normals
from tableverse_factory.robotics.grasps.antipodal import sample_antipodal_grasps
from tableverse_factory.robotics.grasps.clearance import TABLE_CLEARANCE_M, find_clear_grasps
from tableverse_factory.robotics.robots.gripper_clearance import STANDOFF_M, compute_approach_openings
from tests.helpers.examples import scale_examples
from tests.helpers.simple_bodies import box, cup, middle, standing

FAR = np.array([[10.0, 10.0, 10.0]])
"""Points of a body that is not there."""


def one_grasp(rotation, position, width=0.03) -> Grasps:
    return Grasps(np.array([rotation]), np.array([position], dtype=float), np.array([width]), np.ones(1))


def down(turn: float = 0.0, lean: float = 0.0) -> np.ndarray:
    """A gripper that comes from above, turned about the vertical and leaning [rad]."""
    upside = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    about_z = trimesh.transformations.rotation_matrix(turn, [0, 0, 1])[:3, :3]
    about_y = trimesh.transformations.rotation_matrix(lean, [0, 1, 0])[:3, :3]
    return about_z @ about_y @ upside


def swept(arm, grasps) -> np.ndarray:
    """Points of the gripper's boxes, their corners among them, at many places of its straight way. Shape (n, 3)."""
    opening = float(compute_approach_openings(grasps.widths, arm.max_opening_m)[0])
    steps = np.linspace(-1.0, 1.0, 5)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 1, 3)
    centers, halves = arm.shape.boxes(opening)
    points = (centers + grid * halves).reshape(-1, 3) @ grasps.rotations[0].T + grasps.positions[0]
    backs = np.linspace(0.0, STANDOFF_M, 9)[:, None, None]
    return (points - backs * grasps.rotations[0][:, 2]).reshape(-1, 3)


@given(st.floats(-3.0, 3.0), st.floats(-1.5, 1.5), st.floats(0.0, 0.2), st.floats(0.0, 0.08))
@settings(max_examples=scale_examples(60))
def test_nothing_of_the_gripper_is_ever_below_the_table(arm, turn, lean, height, width):
    grasps = one_grasp(down(turn, lean), [0.0, 0.0, height], width)
    lowest = swept(arm, grasps)[:, 2].min()
    if find_clear_grasps(grasps, arm.shape, arm.max_opening_m, FAR, [])[0]:
        assert lowest >= TABLE_CLEARANCE_M - 1e-9
    else:
        assert lowest <= TABLE_CLEARANCE_M + 1e-9


def test_a_grasp_from_below_has_no_room(arm):
    up = down() @ np.diag([1.0, -1.0, -1.0])
    assert not find_clear_grasps(one_grasp(up, [0.0, 0.0, 0.05]), arm.shape, arm.max_opening_m, FAR, [])[0]


@pytest.mark.parametrize(
    ("place", "free"),
    [
        ((0.0, 0.3, 0.05), True),  # beside
        ((0.0, 0.0, 0.05), False),  # between the fingers
        ((0.0, 0.035, 0.06), False),  # under a finger
        ((0.0, 0.09, 0.14), False),  # under the hand
        ((0.0, 0.0, 0.30), True),  # above the whole way
        ((0.0, 0.0, 0.19), False),  # in the way from the stand-off
    ],
)
def test_other_things_are_kept_clear_of_along_the_whole_way(arm, place, free):
    other = trimesh.creation.box([0.02, 0.02, 0.02])
    other.apply_translation(place)
    grasps = one_grasp(down(), [0.0, 0.0, 0.05])
    assert find_clear_grasps(grasps, arm.shape, arm.max_opening_m, FAR, [from_trimesh(other)])[0] == free


@given(st.floats(-3.0, 3.0), st.floats(-0.8, 0.8), st.tuples(*[st.floats(-0.15, 0.15)] * 2), st.floats(0.02, 0.25))
@settings(max_examples=scale_examples(80))
def test_what_passes_touches_no_other_thing(arm, turn, lean, at, height):
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.03)
    ball.apply_translation([*at, height])
    grasps = one_grasp(down(turn, lean), [0.0, 0.0, 0.12])
    if not find_clear_grasps(grasps, arm.shape, arm.max_opening_m, FAR, [from_trimesh(ball)])[0]:
        return
    above = (swept(arm, grasps) @ ball.face_normals.T - (ball.triangles_center * ball.face_normals).sum(axis=1)).max(
        axis=1
    )
    assert above.min() > 0.0, "a point of the gripper is inside"


def test_the_hand_does_not_go_through_what_it_holds(arm):
    mesh = box(0.05, 0.03, 0.16)
    own, _ = sample_inward_normals(mesh, 1500)
    low = one_grasp(down(np.pi / 2), [0.0, 0.0, 0.05], 0.05)
    high = one_grasp(down(np.pi / 2), [0.0, 0.0, 0.14], 0.05)
    assert not find_clear_grasps(low, arm.shape, arm.max_opening_m, own, [])[0], (
        "11 cm of the box would be inside the hand"
    )
    assert find_clear_grasps(high, arm.shape, arm.max_opening_m, own, [])[0]


@pytest.mark.parametrize("mesh", [cup(), box(0.06, 0.04, 0.09)], ids=["cup", "box"])
def test_fingers_do_not_come_down_on_the_body(arm, mesh):
    found = sample_antipodal_grasps(
        mesh, mesh, arm.shape, arm.max_opening_m, middle(mesh), TrajectoriesConfig(), np.random.default_rng(0)
    )
    own, _ = sample_inward_normals(mesh, 1500)
    free = found.select(
        np.flatnonzero(find_clear_grasps(found, arm.shape, arm.max_opening_m, own, [])).astype(np.int32)
    )
    assert 20 < len(free) < len(found)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
    dense = solid.sample(20_000, seed=1)
    inside = 0
    for k in range(0, len(free), max(1, len(free) // 40)):
        opening = float(compute_approach_openings(free.widths[k : k + 1], arm.max_opening_m)[0])
        local = (dense - free.positions[k]) @ free.rotations[k]
        centers, halves = arm.shape.boxes(opening)
        deep = np.abs(local[:, None] - centers) <= halves - 0.004
        inside += bool(deep.all(axis=2).any())
    assert inside == 0, "more than the gaps between the points of the body"


def test_no_grasps_and_no_things_are_no_error(arm):
    none = Grasps(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    flat = TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 2]], dtype=np.int32))
    assert find_clear_grasps(none, arm.shape, arm.max_opening_m, FAR, [flat]).shape == (0,)
    ball = standing(trimesh.creation.icosphere(subdivisions=1, radius=0.03))
    assert find_clear_grasps(none, arm.shape, arm.max_opening_m, FAR, [ball]).shape == (0,)
