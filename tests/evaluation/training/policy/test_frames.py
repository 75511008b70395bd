"""What the networks are told does not depend on where the scene stands, and a reflected scene reads like itself."""

from typing import Any

import pytest

torch = pytest.importorskip("torch", reason="the extra `models` is not installed")
from tableverse_factory.evaluation.training.policy import goals, motions  # noqa: E402
from tableverse_factory.evaluation.training.policy.rotations import (  # noqa: E402
    apply,
    columns_from_matrix,
    matrix_from_columns,
    matrix_from_quaternion,
    matrix_from_vector,
    turn_about_z,
    vector_from_matrix,
)

COUNT = 4
PLAIN, MIRRORED = torch.zeros(COUNT, dtype=torch.bool), torch.ones(COUNT, dtype=torch.bool)
ZERO = torch.zeros(COUNT)


def random_turns(*shape: int) -> Any:
    return matrix_from_quaternion(torch.randn(*shape, 4))


def make_scenes() -> goals.Scenes:
    torch.manual_seed(3)
    points = 0.2 * torch.randn(COUNT, 3, goals.DRAWN_POINTS, 3) + torch.randn(COUNT, 3, 1, 3)
    base_turn = turn_about_z(torch.randn(COUNT))
    side = torch.tensor([[-1.0, 0.0], [0.0, 1.0], [0.0, 0.0], [1.0, 0.0]])
    present = torch.ones(COUNT, 3, dtype=torch.bool)
    return goals.Scenes(points, present, torch.randn(COUNT, 3), base_turn, torch.tensor([4, 4, 0, 4]), side)


def tell(scenes: goals.Scenes, release: Any, grasp: tuple[Any, Any], mirror: Any) -> tuple[Any, ...]:
    """All that the network of goals is told or taught."""
    frame = goals.find_frame(scenes, release, ZERO, mirror)
    opening = torch.full((COUNT,), 0.05)
    vector = goals.encode_grasp(scenes, frame, *grasp, opening, opening)
    task = goals.describe_task(scenes, frame, release, vector[:, :9])
    return goals.select_points(scenes, frame)[0], task, vector


def test_rotations_invert() -> None:
    torch.manual_seed(0)
    turns = random_turns(50)
    assert torch.allclose(matrix_from_columns(columns_from_matrix(turns)), turns, atol=1e-5)
    assert torch.allclose(matrix_from_vector(vector_from_matrix(turns)), turns, atol=1e-3)
    assert torch.equal(matrix_from_vector(torch.zeros(1, 3)), torch.eye(3)[None])
    small = torch.tensor([[1e-4, -2e-4, 3e-4]])
    assert torch.allclose(vector_from_matrix(matrix_from_vector(small)), small, atol=1e-6)


@pytest.mark.parametrize("release", [False, True])
def test_goals_invert_and_follow_the_scene(release: bool) -> None:
    scenes, flag = make_scenes(), torch.full((COUNT,), release)
    grasp = scenes.middle[:, 0] + 0.05 * torch.randn(COUNT, 3), random_turns(COUNT)
    frame = goals.find_frame(scenes, flag, ZERO, PLAIN)
    openings = torch.rand(2, COUNT) * 0.08
    if release:
        goal = goals.encode_release(frame, *grasp, *openings)
        found = goals.decode_release(frame, goal[:, None])
    else:
        goal = goals.encode_grasp(scenes, frame, *grasp, *openings)
        found = goals.decode_grasp(scenes, frame, goal[:, None])
    assert torch.allclose(found[0][:, 0], grasp[0], atol=1e-5)
    assert torch.allclose(found[1][:, 0], grasp[1], atol=1e-5)
    assert torch.allclose(goals.decode_openings(goal), openings.T, atol=1e-6)


@pytest.mark.parametrize("release", [False, True])
def test_a_scene_elsewhere_reads_the_same(release: bool) -> None:
    scenes, flag = make_scenes(), torch.full((COUNT,), release)
    grasp = scenes.middle[:, 0] + 0.05 * torch.randn(COUNT, 3), random_turns(COUNT)
    turn, shift = turn_about_z(torch.full((COUNT,), 0.7)), torch.tensor([0.3, -0.2, 0.0])
    side = (turn[:, :2, :2] @ scenes.side[..., None])[..., 0]
    moved = goals.Scenes(
        apply(turn[:, None, None], scenes.points) + shift,
        scenes.present,
        apply(turn, scenes.base_at) + shift,
        turn @ scenes.base_turn,
        scenes.kind,
        side,
    )
    carried = apply(turn, grasp[0]) + shift, turn @ grasp[1]
    for one, other in zip(tell(scenes, flag, grasp, PLAIN), tell(moved, flag, carried, PLAIN), strict=True):
        assert torch.allclose(one, other, atol=1e-4)


@pytest.mark.parametrize("release", [False, True])
def test_a_reflected_scene_reads_like_its_reflection(release: bool) -> None:
    scenes, flag = make_scenes(), torch.full((COUNT,), release)
    grasp = scenes.middle[:, 0] + 0.05 * torch.randn(COUNT, 3), random_turns(COUNT)
    reflect = torch.tensor([1.0, -1.0, 1.0])
    both = reflect[:, None] * reflect
    reflected = goals.Scenes(
        scenes.points * reflect,
        scenes.present,
        scenes.base_at * reflect,
        scenes.base_turn * both,
        scenes.kind,
        scenes.side * reflect[:2],
    )
    other_grasp = grasp[0] * reflect, grasp[1] * both
    for one, other in zip(tell(scenes, flag, grasp, MIRRORED), tell(reflected, flag, other_grasp, PLAIN), strict=True):
        assert torch.allclose(one, other, atol=1e-4)


def test_chunks_invert_and_reflect() -> None:
    torch.manual_seed(1)
    state = motions.RobotState(
        torch.randn(COUNT, 3), random_turns(COUNT), torch.rand(COUNT, 2) * 0.08, torch.randn(COUNT, 3),
        random_turns(COUNT), torch.rand(COUNT, 2) * 0.08, torch.tensor([0, 1, 3, 5]), torch.randn(COUNT, 3),
        torch.rand(COUNT), torch.randn(COUNT, 3), random_turns(COUNT),
    )  # fmt: skip
    at, opening = torch.randn(COUNT, 2, 3), torch.rand(COUNT, 2) * 0.08
    turn = matrix_from_vector(torch.randn(COUNT, 2, 3)) @ state.tcp_turn[:, None]
    plain, reflect = torch.ones(COUNT, 3), torch.tensor([[1.0, -1.0, 1.0]]).expand(COUNT, -1)
    chunk, left = motions.encode_chunk(state, at, turn, opening, plain)
    found = motions.decode_chunk(state, chunk)
    for one, other in zip(found, (at, turn, opening), strict=True):
        assert torch.allclose(one, other, atol=1e-3)
    assert torch.allclose(left, (at - state.goal_at[:, None]).norm(dim=2))
    mirrored, _ = motions.encode_chunk(state, at, turn, opening, reflect)
    signs = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0])  # a rotation vector is reflected as an axis is
    assert torch.allclose(mirrored, chunk * signs, atol=1e-4)
    assert not torch.allclose(motions.describe_state(state, plain), motions.describe_state(state, reflect))
