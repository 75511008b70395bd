"""Figures of goals and motions against those of demonstrations."""

from typing import Any

from tableverse_factory.evaluation.training.policy.goals import decode_rotation
from tableverse_factory.evaluation.training.policy.network import GOAL
from tableverse_factory.evaluation.training.policy.select import select_goals
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

SEED = 1_000_003
GOALS, CHUNKS, DRAWN = 128, 1024, 32


def measure_goals(
    network: Any, memory: tuple[Tensor, Tensor], goal: Tensor, release: Tensor, units_m: tuple[float, float]
) -> dict[str, float]:
    """Measure drawn grasps and releases against recorded ones.

    Args:
        network: Of goals.
        memory: What it encoded.
        goal: The recorded ones. Shape (b, GOAL).
        release: Which of them are releases. Shape (b,).
        units_m: Units of the positions of grasps and of releases [m].

    Returns:
        `…_mm` and `…_deg`, medians of the distance of the selected goal from the recorded one; `…_nearest_mm`, of the
        nearest of all that were drawn.
    """
    count = len(goal)
    with torch.no_grad():
        drawn = network.draw(memory, torch.randn(count, DRAWN, GOAL, device=goal.device))
    chosen = drawn[torch.arange(count), select_goals(drawn)[:, 0]]
    between = decode_rotation(chosen) @ decode_rotation(goal).mT
    trace = between.diagonal(dim1=1, dim2=2).sum(1)
    degrees = ((trace - 1) / 2).clamp(-1.0, 1.0).acos().rad2deg()
    figures: dict[str, float] = {}
    for name, mask, unit in zip(("grasp", "release"), (~release, release), units_m, strict=True):
        away = (chosen - goal)[:, :3].norm(dim=1) * unit * 1000
        nearest = (drawn - goal[:, None])[..., :3].norm(dim=2).amin(1) * unit * 1000
        figures |= {f"{name}_mm": float(away[mask].median()), f"{name}_deg": float(degrees[mask].median())}
        figures[f"{name}_nearest_mm"] = float(nearest[mask].median())
    return figures
