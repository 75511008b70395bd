"""Goals from pictures: the network that sees the front and the wrist camera at home, and reads the instruction.

Both cameras are fixed to the robot as it stands at home, so goals are poses of the gripper in the frame of its base.
"""

from typing import Any

from tableverse_factory.evaluation.training.policy import network
from tableverse_factory.evaluation.training.policy.first_pictures import CAMERAS, VOCABULARY, WORDS
from tableverse_factory.evaluation.training.policy.goals import decode_rotation, join_goal
from tableverse_factory.evaluation.training.policy.network import ChunkNetwork, GoalFlow, make_perceptron
from tableverse_factory.evaluation.training.policy.rotations import apply
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()
nn, functional = torch.nn, torch.nn.functional
Module: Any = nn.Module

STRIDE = 8  # pixels of a picture per token, along each side
ROWS, COLUMNS = 12, 16
CHANNELS = (32, 64, 128)
REACH_M = 0.55  # middle of the goals along the base's x
UNIT_M = 0.15
GRASP = 9  # numbers of the grasp that belongs to a release


class PictureGoalNetwork(GoalFlow):
    """Goals from pictures and words."""

    def __init__(self) -> None:
        super().__init__()
        width = network.WIDTH
        self.cameras = nn.ModuleList([_make_stem(width) for _ in CAMERAS])
        self.place = nn.Parameter(0.02 * torch.randn(len(CAMERAS), ROWS * COLUMNS, width))
        self.word = nn.Embedding(VOCABULARY, width, padding_idx=0)
        self.order = nn.Parameter(0.02 * torch.randn(WORDS, width))
        self.task = make_perceptron(1 + GRASP, width)

    def encode(self, pictures: Tensor, words: Tensor, release: Tensor, grasp: Tensor) -> tuple[Tensor, Tensor]:
        """Encode what is seen and asked for.

        Args:
            pictures: From 0 to 1. Shape (b, cameras, 3, h, w).
            words: Their numbers. Shape (b, WORDS).
            release: Whether a release is wanted, else a grasp. Shape (b,).
            grasp: The grasp, as a goal, that a release belongs to. Shape (b, GRASP).

        Returns:
            Tokens, and which of them are there.
        """
        told = release.to(grasp.dtype)[:, None]
        tokens = [self.task(torch.cat([told, grasp * told], 1))[:, None], self.word(words) + self.order]
        for camera, stem in enumerate(self.cameras):
            seen = stem(4 * pictures[:, camera] - 2).flatten(2).transpose(1, 2)
            tokens.append(seen + self.place[camera])
        joined = torch.cat(tokens, 1)
        mask = torch.ones(joined.shape[:2], dtype=torch.bool, device=words.device)
        mask[:, 1 : 1 + WORDS] = words > 0
        return self.attend(joined, mask)


def _make_stem(width: int) -> Any:
    """Make convolutions from a picture to tokens of `STRIDE` pixels."""
    parts: list[Any] = []
    inputs = 3
    for outputs in CHANNELS:
        parts += [nn.Conv2d(inputs, outputs, 3, 2, 1), nn.GroupNorm(8, outputs), nn.GELU()]
        parts += [nn.Conv2d(outputs, outputs, 3, 1, 1), nn.GroupNorm(8, outputs), nn.GELU()]
        inputs = outputs
    return nn.Sequential(*parts, nn.Conv2d(inputs, width, 1))


class PictureNetwork(Module):  # type: ignore[misc]
    """Goals from pictures, and the motions of a policy on states, which need no object."""

    def __init__(self) -> None:
        super().__init__()
        self.goal, self.motion = PictureGoalNetwork(), ChunkNetwork()


def make_picture_network(seed: int) -> Any:
    """Make the networks with weights from a seed, on the CPU."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return PictureNetwork()


def encode_pose(base: tuple[Tensor, Tensor], pose: tuple[Tensor, Tensor], opening: Tensor, holding: Tensor) -> Tensor:
    """Encode poses of the gripper, (b, 3) and (b, 3, 3), with their openings, as goals. Shape (b, GOAL)."""
    x, y, z = apply(base[1].mT, pose[0] - base[0]).unbind(-1)
    position = torch.stack([x - REACH_M, y, z], -1) / UNIT_M
    return join_goal(position, base[1].mT @ pose[1], opening, holding)


def decode_pose(base: tuple[Tensor, Tensor], goals: Tensor) -> tuple[Tensor, Tensor]:
    """Decode goals, (b, m, GOAL), to poses of the gripper in the table frame: (b, m, 3) and (b, m, 3, 3)."""
    x, y, z = (goals[..., :3] * UNIT_M).unbind(-1)
    at = apply(base[1][:, None], torch.stack([x + REACH_M, y, z], -1)) + base[0][:, None]
    return at, base[1][:, None] @ decode_rotation(goals)
