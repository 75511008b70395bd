"""Goals: where the gripper grasps X, and where it lets go of it, as vectors that a network draws.

A grasp is the pose of the gripper about the middle of X's points. A release is the rigid motion of X from where it
stands, with the place of its middle about Y's: so the network need not know how X lies in the hand. Both are given
along axes whose x points from the base to that middle, so that they do not depend on where the scene stands.
"""

from dataclasses import dataclass

from tableverse_factory.evaluation.training.policy.network import GOAL
from tableverse_factory.evaluation.training.policy.rotations import (
    apply,
    columns_from_matrix,
    matrix_from_columns,
    turn_about_z,
)
from tableverse_factory.evaluation.training.policy.tensors import KINDS
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()
functional = torch.nn.functional

X_POINTS, Y_POINTS, OTHER_POINTS = 128, 63, 16  # with the task, a multiple of 8: the fast kernels want that
DRAWN_POINTS = X_POINTS
GRASP_UNIT_M, PLACE_UNIT_M = 0.05, 0.15
OPENING_UNIT_M = 0.04
WIDTH_M = 0.08  # openings are counted from the middle of 0 and this


@dataclass(frozen=True, slots=True)
class GoalFrame:
    """Frame of a goal in the table frame; `mirror` (b, 3) has -1 for y where the scene is reflected."""

    at: Tensor
    turn: Tensor
    mirror: Tensor

    def localize(self, points: Tensor) -> Tensor:
        """Express points of the table frame here. Shape (b, …, 3)."""
        return self.turn_in(points - _widen(self.at, points))

    def turn_in(self, vectors: Tensor) -> Tensor:
        """Express directions here. Shape (b, …, 3)."""
        return apply(_widen(self.turn, vectors).mT, vectors) * _widen(self.mirror, vectors)

    def rotation_in(self, rotation: Tensor) -> Tensor:
        """Express the orientation of a gripper here; a reflected gripper is one again, with its fingers swapped."""
        return self.turn.mT @ rotation * self.mirror[:, :, None] * self.mirror[:, None, :]

    def motion_in(self, rotation: Tensor) -> Tensor:
        """Express a rotation from the table frame to itself here."""
        return self.turn.mT @ rotation @ self.turn * self.mirror[:, :, None] * self.mirror[:, None, :]


def _widen(value: Tensor, like: Tensor) -> Tensor:
    """Insert dimensions behind the first, so that (b, …) broadcasts over (b, …, 3)."""
    tail = value.dim() - 1 if value.dim() == 2 else 2
    return value.reshape(len(value), *[1] * (like.dim() - 2), *value.shape[-tail:])


@dataclass(frozen=True, slots=True)
class Scenes:
    """Scenes before a motion, in the table frame; `middle` are those of the points of X and of Y, (b, 2, 3)."""

    points: Tensor  # (b, r, DRAWN_POINTS, 3)
    present: Tensor  # (b, r)
    base_at: Tensor
    base_turn: Tensor
    kind: Tensor  # of the relation
    side: Tensor

    @property
    def middle(self) -> Tensor:
        """Middles of X and of Y. Shape (b, 2, 3)."""
        return self.points[:, :2].mean(2)


def find_frame(scenes: Scenes, release: Tensor, turn: Tensor, mirror: Tensor) -> GoalFrame:
    """Find the frame of grasps about X, and of releases, where `release`, about Y at the height of X's middle.

    `turn` [rad] and `mirror` augment it; both 0 and false give the frame itself. All of shape (b,).
    """
    x, y = scenes.middle.unbind(1)
    at = torch.where(release[:, None], torch.cat([y[:, :2], x[:, 2:]], 1), x)
    away = at - scenes.base_at
    angle = torch.atan2(away[:, 1], away[:, 0]) + turn
    reflected = torch.ones_like(at)
    reflected[:, 1] = torch.where(mirror, -1.0, 1.0)
    return GoalFrame(at, turn_about_z(angle), reflected)


def encode_grasp(
    scenes: Scenes, frame: GoalFrame, at: Tensor, turn: Tensor, opening: Tensor, holding: Tensor
) -> Tensor:
    """Encode grasps: the gripper's pose, the opening on the way there, and the one that holds. Shape (b, GOAL)."""
    position = frame.turn_in(at - scenes.middle[:, 0]) / GRASP_UNIT_M
    return join_goal(position, frame.rotation_in(turn), opening, holding)


def encode_release(frame: GoalFrame, middle: Tensor, motion: Tensor, opening: Tensor, holding: Tensor) -> Tensor:
    """Encode releases: where X's middle comes to be, its rotation from where it stood, the opening. Shape (b, GOAL)."""
    return join_goal(frame.localize(middle) / PLACE_UNIT_M, frame.motion_in(motion), opening, holding)


def join_goal(position: Tensor, rotation: Tensor, opening: Tensor, holding: Tensor) -> Tensor:
    """Join the parts of goals; position in units of its own, openings [m]. Shape (b, GOAL)."""
    fingers = (torch.stack([opening, holding], 1) - WIDTH_M / 2) / OPENING_UNIT_M
    return torch.cat([position, 1.5 * columns_from_matrix(rotation), fingers], 1)


def decode_rotation(goals: Tensor) -> Tensor:
    """Decode the rotations of goals. Shapes (…, GOAL) and (…, 3, 3)."""
    return matrix_from_columns(goals[..., 3:9])


def decode_openings(goals: Tensor) -> Tensor:
    """Decode the openings on the way and while holding [m]. Shapes (…, GOAL) and (…, 2)."""
    return (goals[..., 9:GOAL] * OPENING_UNIT_M + WIDTH_M / 2).clamp(0.0, WIDTH_M)


def describe_grasp(scenes: Scenes, frame: GoalFrame, at: Tensor, turn: Tensor) -> Tensor:
    """Describe the grasp to which a release belongs. Shape (b, 9)."""
    position = frame.turn_in(at - scenes.middle[:, 0]) / GRASP_UNIT_M
    return torch.cat([position, columns_from_matrix(frame.rotation_in(turn))], 1)


def describe_task(scenes: Scenes, frame: GoalFrame, release: Tensor, grasp: Tensor) -> Tensor:
    """Describe the task beside the points; `grasp` (b, 9) is only told for releases. Shape (b, QUERY)."""
    side = torch.cat([scenes.side, torch.zeros_like(scenes.side[:, :1])], 1)
    told = release.to(grasp.dtype)[:, None]
    return torch.cat(
        [
            1 - told,
            told,
            functional.one_hot(scenes.kind, KINDS).to(grasp.dtype),
            frame.turn_in(side)[:, :2],
            frame.localize(scenes.base_at),
            frame.at[:, 2:] / 0.1,
            frame.turn_in(scenes.base_turn[:, :, 0])[:, :2],
            grasp * told,
        ],
        1,
    )


def select_points(scenes: Scenes, frame: GoalFrame) -> tuple[Tensor, Tensor, Tensor]:
    """Select the points of each object that the network sees.

    Returns:
        Points in the frame and from the middle of their object, (b, n, 6); roles, (n,); which are there, (b, n).
    """
    groups = ((0, 1, X_POINTS), (1, 2, Y_POINTS), (2, scenes.points.shape[1], OTHER_POINTS))
    rows, roles, masks = [], [], []
    for role, (first, end, count) in enumerate(groups):
        points = scenes.points[:, first:end, :count]
        own = frame.turn_in(points - points.mean(2, keepdim=True))
        rows.append(torch.cat([frame.localize(points), own], -1).flatten(1, 2))
        roles.append(torch.full((rows[-1].shape[1],), role, device=points.device))
        masks.append(scenes.present[:, first:end, None].expand(-1, -1, count).flatten(1, 2))
    return torch.cat(rows, 1), torch.cat(roles), torch.cat(masks, 1)


def decode_grasp(scenes: Scenes, frame: GoalFrame, goals: Tensor) -> tuple[Tensor, Tensor]:
    """Decode the gripper's pose of grasps, (b, m, GOAL), in the table frame: (b, m, 3) and (b, m, 3, 3)."""
    turn = frame.turn[:, None]
    at = apply(turn, goals[..., :3]) * GRASP_UNIT_M + scenes.middle[:, None, 0]
    return at, turn @ decode_rotation(goals)


def decode_release(frame: GoalFrame, goals: Tensor) -> tuple[Tensor, Tensor]:
    """Decode where X's middle comes to be, and its rotation, of releases (b, m, GOAL): (b, m, 3) and (b, m, 3, 3)."""
    turn = frame.turn[:, None]
    at = apply(turn, goals[..., :3]) * PLACE_UNIT_M + frame.at[:, None]
    return at, turn @ decode_rotation(goals) @ turn.mT
