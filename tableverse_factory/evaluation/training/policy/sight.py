"""Sight: the network that marks what an instruction names in the pictures of an arm's cameras."""

from typing import Any

from tableverse_factory.evaluation.training.policy import network
from tableverse_factory.evaluation.training.policy.instructions import WORDS
from tableverse_factory.evaluation.training.policy.network import Attention, ChunkNetwork, GoalNetwork
from tableverse_factory.evaluation.training.policy.packed_pictures import CAMERAS, VOCABULARY, WINDOW
from tableverse_factory.evaluation.training.policy.seen_points import Rays
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()
nn, functional = torch.nn, torch.nn.functional
Module: Any = nn.Module

CHANNELS = (48, 96, 128)  # at a half, a quarter and an eighth of the size; then `network.WIDTH` at a sixteenth
INPUTS = 8  # colours, the point in the base frame, and its x and y along the table's axes
LAYERS = 4  # of attention
MARKS = 3  # X, Y, any object
REACH_M = 0.55  # middle of what is seen along the base's x
UNIT_M = 0.25


class SightNetwork(Module):  # type: ignore[misc]
    """A U-Net over each camera's picture; at its bottom all patches and the words attend to one another."""

    def __init__(self) -> None:
        super().__init__()
        width, (height, breadth) = network.WIDTH, WINDOW
        self.down = nn.ModuleList()
        inputs = INPUTS
        for outputs in (*CHANNELS, width):
            self.down.append(_make_block(inputs, outputs, 2))
            inputs = outputs
        self.place = nn.Parameter(0.02 * torch.randn(len(CAMERAS), height // 16 * breadth // 16, width))
        self.word = nn.Embedding(VOCABULARY, width, padding_idx=0)
        self.order = nn.Parameter(0.02 * torch.randn(WORDS, width))
        self.layers = nn.ModuleList([Attention() for _ in range(LAYERS)])
        self.up = nn.ModuleList()
        for outputs in reversed(CHANNELS):
            self.up.append(_make_block(inputs + outputs, outputs, 1))
            inputs = outputs
        self.mark = nn.Conv2d(inputs, MARKS, 1)

    def forward(self, colors: Tensor, points: Tensor, words: Tensor) -> Tensor:
        """Mark X, Y and all objects.

        Args:
            colors: From 0 to 1. Shape (b, cameras, 3, h, w).
            points: Of each pixel, as `describe_points` gives them. Shape (b, cameras, 5, h, w).
            words: Numbers of the instruction's. Shape (b, WORDS).

        Returns:
            Scores, whose sigmoids are probabilities. Shape (b, cameras, MARKS, h, w).
        """
        x = torch.cat([4 * colors - 2, points], 2).flatten(0, 1)
        kept = []
        for block in self.down:
            x = block(x)
            kept.append(x)
        shape, batch = x.shape, len(words)
        patches = x.flatten(2).transpose(1, 2).reshape(batch, len(CAMERAS), -1, shape[1]) + self.place
        told = self.word(words) + self.order
        tokens = torch.cat([told, patches.flatten(1, 2)], 1)
        mask = torch.ones(tokens.shape[:2], dtype=torch.bool, device=words.device)
        mask[:, :WORDS] = words > 0
        for layer in self.layers:
            tokens = layer(tokens, mask)
        x = tokens[:, WORDS:].reshape(shape[0], -1, shape[1]).transpose(1, 2).reshape(shape)
        for block, beside in zip(self.up, reversed(kept[:-1]), strict=True):
            x = block(torch.cat([functional.interpolate(x, scale_factor=2.0, mode="nearest"), beside], 1))
        marks = functional.interpolate(self.mark(x), scale_factor=2.0, mode="bilinear")
        return marks.unflatten(0, (batch, len(CAMERAS)))


def _make_block(inputs: int, outputs: int, stride: int) -> Any:
    parts: list[Any] = []
    for step, each in ((stride, inputs), (1, outputs)):
        parts += [nn.Conv2d(each, outputs, 3, step, 1), nn.GroupNorm(8, outputs), nn.GELU()]
    return nn.Sequential(*parts)


def describe_points(rays: Rays, depth: Tensor, base_turn: Tensor) -> Tensor:
    """Describe the point that each pixel sees: where it is for the arm, and along the table's axes; 0 where nothing is.

    Shapes (b, m) [m] and (b, 3, 3); (b, cameras, 5, h, w).
    """
    seen = rays.reach(depth)
    along = (base_turn[:, None, :2] * seen[..., None, :]).sum(-1)
    ahead, beside, up = seen.unbind(-1)
    told = torch.stack([ahead - REACH_M, beside, up, *(along / 2).unbind(-1)], -1) / UNIT_M
    told = told * (depth > 0)[..., None]
    return told.reshape(len(depth), len(CAMERAS), *WINDOW, 5).permute(0, 1, 4, 2, 3)


class PictureNetwork(Module):  # type: ignore[misc]
    """Sight, and the two networks of a policy on states, whose goals are trained further on points that are seen."""

    def __init__(self) -> None:
        super().__init__()
        self.sight, self.goal, self.motion = SightNetwork(), GoalNetwork(), ChunkNetwork()


def make_picture_network(seed: int) -> Any:
    """Make the networks with weights from a seed, on the CPU."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return PictureNetwork()
