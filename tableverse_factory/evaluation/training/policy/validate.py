"""Figures of a policy on demonstrations that it was not trained on."""

from typing import Any

from tableverse_factory.evaluation.training.policy.goals import GRASP_UNIT_M, PLACE_UNIT_M, decode_rotation
from tableverse_factory.evaluation.training.policy.losses import compute_chunk_losses
from tableverse_factory.evaluation.training.policy.network import GOAL
from tableverse_factory.evaluation.training.policy.samples import draw_chunks, draw_goals
from tableverse_factory.evaluation.training.policy.select import select_goals
from tableverse_factory.evaluation.training.policy.tensors import DemonstrationTensors
from tableverse_factory.models.local.device import import_torch

torch = import_torch()

SEED = 1_000_003
GOALS, CHUNKS, DRAWN = 128, 1024, 32


def validate_network(network: Any, data: DemonstrationTensors, held_out: bool) -> dict[str, float]:
    """Measure the averaged network on random demonstrations.

    Returns:
        The losses of chunks, and for grasps and releases: `…_mm` and `…_deg`, medians of the distance of the selected
        goal from the recorded one; `…_nearest_mm`, of the nearest of all that were drawn.
    """
    torch.manual_seed(SEED)
    with torch.no_grad():
        batch = draw_goals(data, GOALS, held_out, augment=False)
        memory = network.goal.encode(batch.points, batch.roles, batch.mask, batch.task)
        drawn = network.goal.draw(memory, torch.randn(GOALS, DRAWN, GOAL, device=batch.goal.device))
        chosen = drawn[torch.arange(GOALS), select_goals(drawn)[:, 0]]
        losses = compute_chunk_losses(network.motion, draw_chunks(data, CHUNKS, held_out, augment=False))
    figures = {name: float(each) for name, each in losses.items()}
    between = decode_rotation(chosen) @ decode_rotation(batch.goal).mT
    trace = between.diagonal(dim1=1, dim2=2).sum(1)
    degrees = ((trace - 1) / 2).clamp(-1.0, 1.0).acos().rad2deg()
    for name, mask, unit in (("grasp", ~batch.release, GRASP_UNIT_M), ("release", batch.release, PLACE_UNIT_M)):
        away = (chosen - batch.goal)[:, :3].norm(dim=1) * unit * 1000
        nearest = (drawn - batch.goal[:, None])[..., :3].norm(dim=2).amin(1) * unit * 1000
        figures |= {f"{name}_mm": float(away[mask].median()), f"{name}_deg": float(degrees[mask].median())}
        figures[f"{name}_nearest_mm"] = float(nearest[mask].median())
    return figures
