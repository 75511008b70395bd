"""Losses of the policy's two networks."""

from typing import Any

from tableverse_factory.evaluation.training.policy.network import CHUNK, OPENING_UNIT_M, PHASES, POSITION_UNIT_M
from tableverse_factory.evaluation.training.policy.samples import ChunkBatch
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()
functional = torch.nn.functional

NEAR_M, SHARE = 0.02, 0.15  # an error of a position counts by NEAR_M and this share of the distance to the goal
NEAR_RAD, PER_M = 0.1, 0.5  # and of an orientation by this angle and this much per metre
OPENING_ERROR_M = 0.01
PHASE_WEIGHT = 0.3
SOON, LATER = 1.6, 0.4  # weights of a chunk's first and last sample: the first are executed


def compute_flow_loss(network: Any, memory: tuple[Tensor, Tensor], goal: Tensor, flows: int) -> Tensor:
    """Compute the mean squared error of the field along straight lines from `flows` noises to each goal, (b, GOAL)."""
    goal = goal[:, None].expand(-1, flows, -1)
    noise = torch.randn_like(goal)
    time = torch.sigmoid(1.2 * torch.randn(goal.shape[:2], device=goal.device))
    noisy = noise + time[..., None] * (goal - noise)
    return functional.mse_loss(network.compute_flow(memory, noisy, time), goal - noise)


def compute_chunk_losses(network: Any, batch: ChunkBatch) -> dict[str, Tensor]:
    """Compute the losses of positions, orientations, openings and phases; those near a goal weigh most."""
    chunk = network(batch.state, batch.points, batch.mask)
    position = (chunk[..., :3] - batch.chunk[..., :3]).abs().sum(-1) * POSITION_UNIT_M / (NEAR_M + SHARE * batch.left)
    turn = (chunk[..., 3:6] - batch.chunk[..., 3:6]).abs().sum(-1) / (NEAR_RAD + PER_M * batch.left)
    opening = (chunk[..., 6] - batch.chunk[..., 6]).abs() * OPENING_UNIT_M / OPENING_ERROR_M
    soon = torch.linspace(SOON, LATER, CHUNK, device=chunk.device)
    scores, phases = chunk[..., 7:].reshape(-1, PHASES), batch.phases.reshape(-1)
    return {
        "position": (soon * position).mean(),
        "turn": (soon * turn).mean(),
        "opening": (soon * opening).mean(),
        "phase": PHASE_WEIGHT * functional.cross_entropy(scores, phases),
    }
