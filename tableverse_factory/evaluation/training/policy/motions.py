"""Motions towards a goal: what the network of chunks is told, and how its answer is read.

Everything stands in the goal's frame, the pose that the gripper is to reach: approach, lift and descent then look
alike in all scenes, and what is left to go shrinks to zero. The robot's pose is the commanded one, which the policy
knows exactly.
"""

from dataclasses import dataclass

from tableverse_factory.evaluation.training.policy.network import (
    LINEAR_M,
    OPENING_UNIT_M,
    PHASES,
    POSITION_UNIT_M,
    STATE,
    expand_lengths,
)
from tableverse_factory.evaluation.training.policy.rotations import (
    apply,
    columns_from_matrix,
    matrix_from_vector,
    vector_from_matrix,
)
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()
functional = torch.nn.functional

MOTION_POINTS = 24


@dataclass(frozen=True, slots=True)
class RobotState:
    """State of the robot, in the table frame; lengths in metres, all of b rows."""

    tcp_at: Tensor  # commanded
    tcp_turn: Tensor
    opening: Tensor  # commanded and measured, (b, 2)
    goal_at: Tensor
    goal_turn: Tensor
    fingers: Tensor  # openings on the way to the goal and while holding, (b, 2)
    phase: Tensor  # of the last command
    moved: Tensor  # from the pose of the grasp, once X is lifted; else 0; (b, 3)
    since: Tensor  # when the phase began [s]
    base_at: Tensor
    base_turn: Tensor


def describe_state(state: RobotState, mirror: Tensor) -> Tensor:
    """Describe the state in the goal's frame, reflected in its y where `mirror` (b, 3) is -1. Shape (b, STATE)."""
    back = state.goal_turn.mT

    def turn_in(vectors: Tensor) -> Tensor:
        return apply(back, vectors) * mirror

    up = torch.zeros_like(state.tcp_at)
    up[:, 2] = 1.0
    rotation = back @ state.tcp_turn * mirror[:, :, None] * mirror[:, None, :]
    told = torch.cat(
        [
            expand_lengths(turn_in(state.tcp_at - state.goal_at), (LINEAR_M, 0.05, 0.01)),
            columns_from_matrix(rotation),
            turn_in(up),
            turn_in(state.base_at - state.goal_at),
            turn_in(state.base_turn[:, :, 0]),
            torch.cat([state.opening, state.fingers], 1) / OPENING_UNIT_M,
            expand_lengths(turn_in(state.moved), (0.3, 0.03)),
            functional.one_hot(state.phase, PHASES).to(up.dtype),
            state.goal_at[:, 2:] / 0.3,
            state.tcp_at[:, 2:] / 0.3,
            state.since[:, None].clamp(max=2.0),
            torch.tanh(state.since[:, None] / 0.2),
        ],
        1,
    )
    assert told.shape[1] == STATE  # noqa: S101 both are constants of the code
    return told


def localize_points(points: Tensor, goal_at: Tensor, goal_turn: Tensor, mirror: Tensor) -> Tensor:
    """Express points of objects in the goal's frame. Shape (b, r, p, 3)."""
    return apply(goal_turn.mT[:, None, None], points - goal_at[:, None, None]) * mirror[:, None, None]


def encode_chunk(
    state: RobotState, tcp_at: Tensor, tcp_turn: Tensor, opening: Tensor, mirror: Tensor
) -> tuple[Tensor, Tensor]:
    """Encode the next poses, (b, k, 3) and (b, k, 3, 3) in the table frame, and openings, (b, k), as in `ChunkNetwork`.

    Returns:
        Position, rotation vector and opening, (b, k, 7), and the distance left to the goal [m], (b, k).
    """
    back, reflect = state.goal_turn.mT[:, None], mirror[:, None]
    position = apply(back, tcp_at - state.tcp_at[:, None]) * reflect
    between = back @ tcp_turn @ state.tcp_turn.mT[:, None] @ state.goal_turn[:, None]
    between = between * reflect[..., :, None] * reflect[..., None, :]
    left = (tcp_at - state.goal_at[:, None]).norm(dim=-1)
    fingers = opening[..., None] / OPENING_UNIT_M
    return torch.cat([position / POSITION_UNIT_M, vector_from_matrix(between), fingers], -1), left


def decode_chunk(state: RobotState, chunk: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Decode poses of the gripper in the table frame and openings [m]: (b, k, 3), (b, k, 3, 3) and (b, k)."""
    turn = state.goal_turn[:, None]
    at = state.tcp_at[:, None] + apply(turn, chunk[..., :3]) * POSITION_UNIT_M
    rotation = turn @ matrix_from_vector(chunk[..., 3:6]) @ turn.mT @ state.tcp_turn[:, None]
    return at, rotation, (chunk[..., 6] * OPENING_UNIT_M).clamp(0.0, OPENING_UNIT_M)
